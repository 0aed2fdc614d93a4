"""Pages of the documentation that are made from the code: the command line from its dataclasses, schemas from their
numbers, the front page from README.md. A hook of mkdocs; `make docs` runs it."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from dataclasses import MISSING, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that no file holds."""
    pages = {
        "index.md": front_page(),
        "reference/command-line.md": command_line_page(),
        "reference/schemas.md": schemas_page(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def front_page() -> str:
    """Return README.md with links as they are seen from the folder of the documentation."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = text.replace("](docs/", "](")
    return re.sub(r"\[([^\]]*)\]\((?:examples|CONTRIBUTING\.md|LICENSE)[^)]*\)", r"\1", text)


def command_line_page() -> str:
    """Return a section for each command: what it does, and its options with types and defaults."""
    from scene2spad.cli.main import COMMANDS, options_of

    lines = ["# Command line", "", "`scene2spad COMMAND --help` says the same. Written from the code.", ""]
    for name in COMMANDS:
        options = options_of(name)
        told = " ".join(inspect.cleandoc(options.__doc__ or "").split())
        lines += [f"## {name}", "", _plain(told), "", "| option | default | meaning |", "|---|---|---|"]
        words = option_docs(options)
        for one in fields(options):
            default = "required" if one.default is MISSING else f"`{one.default!r}`".replace("|", "\\|")
            kind = "Positional" in str(one.type)
            label = one.name.upper() if kind else "--" + one.name.rstrip("_").replace("_", "-")
            lines.append(f"| `{label}` | {default} | {_plain(words.get(one.name, ''))} |")
        lines.append("")
    return "\n".join(lines)


def option_docs(options: type) -> dict[str, str]:
    """Return the string that stands below each field, of a class and its bases."""
    found: dict[str, str] = {}
    for one in reversed(options.__mro__[:-1]):
        defined = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
        assert isinstance(defined, ast.ClassDef)
        for above, below in pairwise(defined.body):
            if not (isinstance(above, ast.AnnAssign) and isinstance(below, ast.Expr)):
                continue
            if isinstance(above.target, ast.Name) and isinstance(below.value, ast.Constant):
                found[above.target.id] = " ".join(str(below.value.value).split())
    return found


def schemas_page() -> str:
    """Return the schema numbers of our files, and what the datasets of a dense export mean."""
    from scenes.files import SCHEMAS
    from spad.formats.dense import RADIANCE, UNITS

    lines = ["# Files and schemas", "", "Each of our files carries its kind, a schema number and a SHA-256.", ""]
    lines += ["| kind | schema |", "|---|---|", *(f"| {kind} | {number} |" for kind, number in SCHEMAS.items()), ""]
    lines += ["## Transient (.exr)", "", "Deep part `transient`, one sample a return:", ""]
    lines += ["| channel | meaning | unit |", "|---|---|---|"]
    lines += ["| `Z`, `ZBack` | nearest and farthest optical path of the return | m |"]
    lines += ["| `Y` | radiance per joule of the pulse | 1/(m² sr) |", "| `bounces` | surfaces met | |", ""]
    lines += [
        "Flat part `layers`: `depth` [m], `normal.X Y Z`, `albedo`, `ambient` [W/(m² sr nm)], `mixed`, `error`.",
        "",
    ]
    lines += [
        "## Histogram (.h5)",
        "",
        "`counts` (H, W, T), or `timestamps` and `offsets` where these are smaller.",
        "",
    ]
    lines += ["Truth (H, W): `depth_m` [m], `mixed`, `albedo`, `expected_signal`, `expected_background`.", ""]
    lines += ["## Dense export (.npz, .h5)", "", "| dataset | unit | meaning |", "|---|---|---|"]
    lines += [f"| `{name}` | {unit} | {told} |" for name, (unit, told) in UNITS.items()]
    lines += [f"| `data` of a transient | {RADIANCE[0]} | {RADIANCE[1]} |", ""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text in a cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")
