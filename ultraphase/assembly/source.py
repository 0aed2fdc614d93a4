"""Source text as lines of tokens, and a cursor that reads one line: what the assembler stands on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from scenes.errors import InputError

_TOKEN = re.compile(r"\s*(?:(0[xX][0-9a-fA-F]+|0[bB][01]+|\d+)|(\.?[A-Za-z_](?:\w|\{\w+\})*)|(\.\.|[-+*/%()\[\],#:]))")


@dataclass(frozen=True)
class Token:
    text: str
    kind: str  # number, name or mark
    column: int


@dataclass(frozen=True)
class Line:
    """A line of source with the loop variables it stands under."""

    file: str
    number: int
    text: str
    tokens: tuple[Token, ...]
    loops: Mapping[str, int] = field(default_factory=dict)

    def fail(self, column: int, message: str) -> InputError:
        return InputError(f"{self.file}:{self.number}:{column}: {message}")


def source_lines(file: str, text: str) -> list[Line]:
    lines = []
    for number, raw in enumerate(text.splitlines(), start=1):
        code = raw.split(";", 1)[0].rstrip()
        line = Line(file, number, code, ())
        tokens: tuple[Token, ...]
        included = re.match(r'\s*\.include\s+"([^"]*)"\Z', code)
        if included:
            at = included.start(1) + 1
            tokens = (Token(".include", "name", code.index(".") + 1), Token(included[1], "file", at))
        else:
            tokens = tuple(_tokens(line))
        if tokens:
            lines.append(Line(file, number, code, tokens))
    return lines


def _tokens(line: Line) -> Iterator[Token]:
    at = 0
    while at < len(line.text):
        found = _TOKEN.match(line.text, at)
        if not found:
            column = at + len(line.text[at:]) - len(line.text[at:].lstrip()) + 1
            raise line.fail(column, f"unexpected {line.text[column - 1]!r}")
        group = found.lastindex or 0  # one of the three, each of which is one token
        yield Token(found[group], ("number", "name", "mark")[group - 1], found.start(group) + 1)
        at = found.end()


class Cursor:
    """Reads the tokens of one line."""

    def __init__(self, line: Line, start: int = 0) -> None:
        self.line, self.at, self.depth = line, start, 0

    @property
    def next(self) -> Token:
        tokens = self.line.tokens
        return tokens[self.at] if self.at < len(tokens) else Token("", "end", len(self.line.text) + 1)

    def take(self, kind: str, what: str) -> Token:
        token = self.next
        if token.kind != kind:
            raise self.fail(f"expected {what}, found {token.text or 'the end of the line'!r}")
        self.at += 1
        return token

    def mark(self, text: str) -> bool:
        found = self.next.kind == "mark" and self.next.text == text
        self.at += found
        return found

    def expect(self, text: str) -> None:
        if not self.mark(text):
            raise self.fail(f"expected {text!r}, found {self.next.text or 'the end of the line'!r}")

    def end(self) -> None:
        if self.next.kind != "end":
            raise self.fail(f"unexpected {self.next.text!r}")

    def fail(self, message: str) -> InputError:
        return self.line.fail(self.next.column, message)
