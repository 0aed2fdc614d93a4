"""README and how-to pages are easy to read, and what they tell one to type is right (test_page_commands runs it)."""

import re
import shlex
from pathlib import Path

import pytest

from scene2spad.cli.main import parse_command

ROOT = Path(__file__).parents[1]
HOW_TO = ("quickstart", "own-scenes", "scenes", "sensors", "own-data", "scale-out", "exports", "interchange")
PAGES = [ROOT / "README.md", *(ROOT / f"docs/{name}.md" for name in HOW_TO)]
MIN_READING_EASE, MAX_SENTENCE = 45, 35
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)


def prose(page: Path) -> str:
    """Sentences of a page: without code, tables, headings, pictures and addresses."""
    text = BLOCK.sub("\n\n", page.read_text(encoding="utf-8"))
    text = re.sub(r"^(    .*|\|.*|#.*)$", "\n", text, flags=re.M)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    return re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n", text, flags=re.M).replace("**", "")


def sentences(text: str) -> list[list[str]]:
    """Words of each sentence; what is no word, numbers too, is left out. A blank line ends a sentence as well."""
    found = []
    for part in re.split(r"\n\s*\n|(?<=[.!?:;])\s+(?=[A-Z\"(`])|(?<=[.!?])\s+", text):
        words = re.findall(r"[A-Za-z][A-Za-z'’-]*", part)
        found += [words] if words else []
    return found


def syllables(word: str) -> int:
    """Groups of vowels, without a silent e at the end."""
    word = word.lower()
    groups = len(re.findall(r"[aeiouy]+", word))
    silent = word.endswith("e") and not word.endswith(("le", "ee", "ye")) and groups > 1
    return max(1, groups - silent)


def reading_ease(text: str) -> float:
    """Flesch's reading ease: 206.8 - 1.015 words a sentence - 84.6 syllables a word."""
    found = sentences(text)
    words = [word for sentence in found for word in sentence]
    return 206.835 - 1.015 * len(words) / len(found) - 84.6 * sum(map(syllables, words)) / len(words)


def commands(page: Path) -> list[list[str]]:
    """Every command of a page, in fences, indented lines and inline, without comments."""
    text = page.read_text(encoding="utf-8")
    code = [body for kind, body in BLOCK.findall(text) if kind in ("sh", "")]
    text = BLOCK.sub("", text)
    code += re.findall(r"^    (.*(?:\\\n.*)*)$", text, re.M)
    code += re.findall(r"`(scene2spad [^`\n]+)`", text)
    lines = "\n".join(code).replace("\\\n", " ").splitlines()
    found = [shlex.split(line.strip(), comments=True) for line in lines if line.strip().startswith("scene2spad ")]
    return [words[1:] for words in found if len(words) > 1]


def test_known_texts_have_known_ease():
    """Counted by hand: 6 words and 6 syllables in one sentence; 2 words of 5 syllables each."""
    assert reading_ease("The cat sat on the mat.") == pytest.approx(206.835 - 1.015 * 6 - 84.6)
    assert reading_ease("University electricity.") < 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_reads_easily(page):
    text = prose(page)
    long = [" ".join(words) for words in sentences(text) if len(words) > MAX_SENTENCE]
    assert not long, long
    assert reading_ease(text) >= MIN_READING_EASE, f"{reading_ease(text):.1f}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_parses(page):
    found = commands(page)
    assert found
    for words in found:
        if words != ["COMMAND", "--help"]:
            parse_command(words)


def test_how_to_pages_are_those_of_the_site():
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    (part,) = re.findall(r"^  - How-to:\n((?:      .*\n)+)", site, re.M)
    assert {"quickstart", *re.findall(r"(\S+)\.md$", part, re.M)} == {*HOW_TO}
