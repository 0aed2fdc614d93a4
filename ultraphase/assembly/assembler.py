"""The assembler: source text to `Program`.

One statement a line, `;` begins a comment. Numbers are decimal, 0x or 0b; constants are expressions of + - * / % and
parentheses over numbers, `.equ` names, region names (their byte address) and loop variables. A line is `NAME:` (a
label), `OP operand, operand, ...` (see `isa.OPS`), or one of the DIRECTIVES below.

Errors are InputErrors that begin with file, line and column.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes.errors import InputError, did_you_mean, require, require_kind, require_whole
from scenes.io.inputs import file_inside, read_text
from ultraphase.assembly.isa import BY_NAME, DIRECTIONS, REGISTERS, VALUE_BITS, Instruction
from ultraphase.assembly.names import MAX_VALUE, Names, name_of
from ultraphase.assembly.program import KINDS, Program, Region
from ultraphase.assembly.source import Cursor, Line, Token, source_lines
from ultraphase.chip import ChipSpec, chosen_chip

_MAX_STATEMENTS = 20_000
_MAX_INCLUDES = 8  # inside one another
_MAX_NESTED = 32  # loops
_MAX_REPEATED = 1 << 18  # lines of all loops' turns, those of loops inside others counted each time
_MAX_BYTES = 1 << 22

# What each takes, and what it does.
DIRECTIVES: dict[str, tuple[str, str]] = {
    ".equ": ("NAME, value", "a constant; `--define NAME=VALUE` wins over it. MAX_SHIFT is the chip's"),
    ".reg": ("NAME, register", "another name for a register, from here on; `r1 + n` is the n-th after r1"),
    ".table": (
        "NAME, kind, count[, values]",
        "RAM that is filled before the program runs; kind is u8, s8 or s16. Without values they come by `--table`",
    ),
    ".space": ("NAME, kind, count", "RAM that the program writes, zero at first"),
    ".for": ("NAME in FIRST..LAST", "the lines to `.end`, once for every value of NAME, FIRST and LAST included"),
    ".end": ("", "ends the lines of `.for`"),
    ".include": ('"FILE"', "the lines of another file of the same folder; inside a loop they see its variables"),
}
Reader = Callable[[str], str]


def assemble(
    text: str,
    *,
    name: str = "program",
    constants: Mapping[str, int] | None = None,
    chip: ChipSpec | None = None,
    read: Reader | None = None,
) -> Program:
    """Return source to program, checked against the chip.

    name        what messages call the source
    constants   whole numbers by name that win over the source's `.equ`
    read        gives the text of an included file's name; without it `.include` is refused

    Raises InputError with file, line and column for a mistake in the source, and with what is over for a program that
    does not fit the chip.

    Examples
    --------
    Each of two cores side by side puts out the first timestamp of its frame:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> program = s2s.assemble('''
    ...         RDT  r1
    ...         OUTH r1
    ...         HALT
    ... ''', name="first.s")
    >>> cores = s2s.CoreArray(program, (1, 2))
    >>> frame = cores.frame(np.array([500, 700, 30]), np.array([0, 2, 3]))  # two photons on the left, one on the right
    >>> frame.out.tolist(), frame.cycles.tolist()  # 3 instructions of 3 clocks
    ([[500], [30]], [[9, 9]])
    """
    require_kind(text, str, "assemble", " of source (`assemble_file` takes a path)")
    assembly = _Assembly(chosen_chip(chip, "assemble"), _whole_constants(constants, "assemble"), read)
    assembly.take(source_lines(name, text))
    return assembly.program(name)


def assemble_file(
    path: Path,
    constants: Mapping[str, int] | None = None,
    chip: ChipSpec | None = None,
    name: str | None = None,
) -> Program:
    """Return `assemble` of a file, called by its own name or by `name`; files that it includes are looked for beside
    it."""
    require(isinstance(path, str | Path), f"assemble_file: expected the path of a source, not {type(path).__name__}")
    path = Path(path)

    def read(name: str) -> str:
        return _source_text(file_inside(path.parent, name, "included file", "the program's folder"))

    assembly = _Assembly(chosen_chip(chip, "assemble_file"), _whole_constants(constants, "assemble_file"), read)
    assembly.take(source_lines(path.name, _source_text(path)))
    return assembly.program(name or path.name)


def _whole_constants(constants: Mapping[str, int] | None, where: str) -> dict[str, int]:
    """Return constants as Python's whole numbers; InputError for anything else, and for one that 32 bits do not
    hold."""
    if constants is None:
        return {}
    named = isinstance(constants, Mapping) and all(isinstance(name, str) for name in constants)
    require(named, f"{where}: constants {constants!r}, expected whole numbers by name")
    whole = {name: require_whole(value, f"{where}: constant {name}") for name, value in constants.items()}
    for name, value in whole.items():
        require(abs(value) < MAX_VALUE, f"{where}: constant {name} {value} does not fit into 32 bits")
    return whole


def _source_text(path: Path) -> str:
    return read_text(path, "assembler source", most_bytes=_MAX_BYTES)


class _Assembly:
    """State of an assembly while its lines are taken in order; labels are resolved last, as branches may look ahead."""

    def __init__(self, chip: ChipSpec, given: dict[str, int], read: Reader | None) -> None:
        self.chip, self.read, self.max_shift = chip, read, chip.max_shift
        self.names = Names(given, {"MAX_SHIFT": chip.max_shift})
        self.regions: list[Region] = []
        self.pending: list[tuple[Cursor, Instruction, dict[str, Token]]] = []
        self.includes = self.statements = self.repeated = self.loops = 0

    def take(self, lines: list[Line]) -> None:
        """Take all lines of a file, or of one turn of a loop."""
        at = 0
        while at < len(lines):
            word = lines[at].tokens[0].text
            if word == ".for":
                body = self._body(lines, at)
                self._loop(lines[at], lines[at + 1 : body])
                at = body + 1
                continue
            self.statements += 1
            if self.statements > _MAX_STATEMENTS:
                raise lines[at].fail(1, f"more than {_MAX_STATEMENTS} statements")
            self._statement(lines[at])
            at += 1

    @staticmethod
    def _body(lines: list[Line], start: int) -> int:
        """Index of the .end that belongs to the .for at `start`."""
        depth = 0
        for at in range(start, len(lines)):
            depth += {".for": 1, ".end": -1}.get(lines[at].tokens[0].text, 0)
            if depth == 0:
                return at
        raise lines[start].fail(lines[start].tokens[0].column, ".for without .end")

    def _loop(self, head: Line, body: list[Line]) -> None:
        cursor = Cursor(head, 1)
        variable = cursor.take("name", "a loop variable")
        if cursor.take("name", "'in'").text != "in":
            raise head.fail(variable.column, "expected: .for NAME in FIRST..LAST")
        first = self.names.expression(cursor)
        cursor.expect("..")
        last = self.names.expression(cursor)
        cursor.end()
        column = head.tokens[0].column
        if self.loops >= _MAX_NESTED:
            raise head.fail(column, f".for inside {_MAX_NESTED} others, expected fewer")
        self.repeated += max(0, last - first + 1) * max(1, len(body))
        if self.repeated > _MAX_REPEATED:
            raise head.fail(column, f"loops repeat {self.repeated} lines, expected {_MAX_REPEATED} at the most")
        self.loops += 1
        for value in range(first, last + 1):
            loops = {**head.loops, variable.text: value}
            self.take([Line(line.file, line.number, line.text, line.tokens, loops) for line in body])
        self.loops -= 1

    def _statement(self, line: Line) -> None:
        cursor = Cursor(line)
        tokens = line.tokens
        while len(tokens) > cursor.at + 1 and tokens[cursor.at + 1].text == ":":
            self.names.label(cursor, len(self.pending))
        if cursor.next.kind == "end":
            return
        token = cursor.take("name", "an instruction, a label or a directive")
        directive = {".equ": self._equ, ".reg": self._reg, ".table": self._region, ".space": self._region}
        if token.text == ".include":
            self._include(line)
        elif token.text in directive:
            directive[token.text](cursor, token)
            cursor.end()
        elif token.text.upper() in BY_NAME:
            self._instruction(cursor, token.text.upper())
            cursor.end()
        else:
            what, known = ("directive", DIRECTIVES) if token.text[0] == "." else ("instruction", BY_NAME)
            meant = did_you_mean(token.text if what == "directive" else token.text.upper(), known)
            raise line.fail(token.column, f"unknown {what} {token.text!r}{meant}")

    def _include(self, line: Line) -> None:
        at = line.tokens[-1]
        if self.read is None or self.includes >= _MAX_INCLUDES or at.kind != "file":
            raise line.fail(at.column, f'.include "file" is not possible here, or more than {_MAX_INCLUDES} deep')
        try:
            text = self.read(at.text)
        except InputError as error:
            raise line.fail(at.column, str(error)) from None
        self.includes += 1
        self.take([replace(one, loops=line.loops) for one in source_lines(at.text, text)])
        self.includes -= 1

    def _equ(self, cursor: Cursor, token: Token) -> None:
        name = self.names.new(cursor, "a constant")
        self.names.define(name, self.names.expression(cursor), constant=True)

    def _reg(self, cursor: Cursor, token: Token) -> None:
        name = self.names.new(cursor, "a register")
        at = cursor.next
        number = self.names.expression(cursor, self.names.registers)
        if not 0 <= number < REGISTERS:
            raise cursor.line.fail(at.column, f"register {number} is outside r0 to r{REGISTERS - 1}")
        self.names.registers[name] = number

    def _region(self, cursor: Cursor, token: Token) -> None:
        at = cursor.next
        name = self.names.new(cursor, "RAM")
        kind = cursor.take("name", "u8, s8 or s16")
        if kind.text not in KINDS:
            raise cursor.line.fail(kind.column, f"kind {kind.text!r}, expected one of {', '.join(KINDS)}")
        cursor.expect(",")
        count = self.names.expression(cursor)
        if not 1 <= count <= 1 << 20:
            raise cursor.line.fail(at.column, f"{name}: {count} values, expected 1 or more")
        values = []
        while token.text == ".table" and cursor.mark(","):
            values.append(self._table_value(cursor, name, kind.text))
        if values and len(values) != count:
            raise cursor.line.fail(at.column, f"{name}: {len(values)} values for {count} places")
        size = KINDS[kind.text].itemsize
        end = max((region.end for region in self.regions), default=0)
        address = -(-end // size) * size
        self.regions.append(Region(name, kind.text, count, address, token.text == ".table", tuple(values)))
        self.names.define(name, address)

    def _table_value(self, cursor: Cursor, name: str, kind: str) -> int:
        at = cursor.next
        value = self.names.expression(cursor)
        limits = np.iinfo(KINDS[kind])
        if not limits.min <= value <= limits.max:
            raise cursor.line.fail(
                at.column, f"{name}: {value} is outside {limits.min} to {limits.max}, those of {kind}"
            )
        return value

    def _instruction(self, cursor: Cursor, name: str) -> None:
        fields: dict[str, int | bool] = {}
        targets: dict[str, Token] = {}
        op = BY_NAME[name]
        for number, kind in enumerate(op.takes):
            if number:
                cursor.expect(",")
            if kind == "m":
                self._ram_operand(cursor, fields, op.size)
            else:
                self._operand(cursor, kind, fields, targets)
        self.pending.append((cursor, Instruction(name, **fields), targets))  # type: ignore[arg-type]

    def _operand(self, cursor: Cursor, kind: str, fields: dict[str, int | bool], targets: dict[str, Token]) -> None:
        if kind in "dt":
            fields["rd"] = self.names.register(cursor)
        elif kind == "s":
            fields["rs"] = self.names.register(cursor)
        elif kind == "v":
            fields["constant"] = cursor.mark("#")
            fields["value"] = self._constant(cursor) if fields["constant"] else self.names.register(cursor)
        elif kind == "n":
            cursor.expect("#")
            at = cursor.next
            fields["value"] = self.names.expression(cursor)
            if not 1 <= fields["value"] <= self.max_shift:
                raise cursor.line.fail(at.column, f"shift by {fields['value']} is outside 1 to {self.max_shift}")
        elif kind == "b":
            cursor.expect("#")
            at = cursor.next
            fields["bit"] = self.names.expression(cursor)
            if not 0 <= fields["bit"] < 32:
                raise cursor.line.fail(at.column, f"bit {fields['bit']} is outside 0 to 31")
        elif kind == "l":
            targets["target"] = cursor.take("name", "a label")
        else:
            token = cursor.take("name", "a direction")
            if token.text not in DIRECTIONS:
                raise cursor.line.fail(token.column, f"direction {token.text!r}, expected {', '.join(DIRECTIONS)}")
            fields["value"] = DIRECTIONS.index(token.text)

    def _ram_operand(self, cursor: Cursor, fields: dict[str, int | bool], size: int) -> None:
        """Parse [register + constant] in any order, or one of the two alone."""
        cursor.expect("[")
        at, base, offset = cursor.next, None, 0
        sign = 1
        while True:
            if self.names.at_register(cursor):
                if base is not None or sign < 0:
                    raise cursor.fail("one base register at the most, and not subtracted")
                base = self.names.register(cursor)
            else:
                offset += sign * self.names.product(cursor, {})
            if cursor.mark("]"):
                break
            sign = 1 if cursor.mark("+") else -1
            if sign < 0:
                cursor.expect("-")
        if base is None:
            self._check_address(cursor.line, at, offset, size)
        fields |= {"constant": base is None, "rs": base or 0, "value": self._in_word(cursor.line, at, offset)}

    def _check_address(self, line: Line, at: Token, address: int, size: int) -> None:
        """Raise InputError for an address that no run can reach; those with a register are checked as they run."""
        last = self.chip.ram_bytes - size
        if not 0 <= address <= last:
            raise line.fail(at.column, f"RAM address {address} is outside 0 to {last}")
        if address % size:
            raise line.fail(at.column, f"RAM address {address} of 16 bits is odd")

    def _constant(self, cursor: Cursor) -> int:
        at = cursor.next
        return self._in_word(cursor.line, at, self.names.expression(cursor))

    @staticmethod
    def _in_word(line: Line, at: Token, value: int) -> int:
        most = 1 << VALUE_BITS - 1
        if not -most <= value < most:
            raise line.fail(at.column, f"constant {value} is outside {-most} to {most - 1}")
        return value

    def program(self, name: str) -> Program:
        """Make the program once all labels are known: the branches find their targets; checked against the chip."""
        self.names.check_given(name)
        instructions = []
        for cursor, instruction, targets in self.pending:
            if targets:
                token = targets["target"]
                label = name_of(cursor.line, token)
                if label not in self.names.labels:
                    raise cursor.line.fail(token.column, f"label {label!r} is not defined")
                target = min(self.names.labels[label], 511)  # one past the store's largest is refused by Program.check
                instruction = Instruction(**{**vars(instruction), "target": target})
            instructions.append(instruction)
        places = tuple((cursor.line.file, cursor.line.number) for cursor, _, _ in self.pending)
        program = Program(name, tuple(instructions), tuple(self.regions), self.names.labels, places)
        program.check(self.chip)
        return program
