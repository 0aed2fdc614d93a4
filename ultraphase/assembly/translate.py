"""Instructions as Python statements: what `Core` compiles, one for a step, a stretch of them for a run.

They work on `r` (16 registers), `ram` and `halves` (the same bytes as signed 16 bits), and `core`; `return` gives the
next word. In the middle of a stretch the next instruction's statements follow instead.
"""

from __future__ import annotations

import re

from ultraphase.assembly.isa import ALU_SPELLED, BYTE_LIMIT, HALF_LIMITS, WORD_LIMITS, WRAP, WRAPPING, Instruction
from ultraphase.assembly.program import Program

LOW, HIGH = HALF_LIMITS
SHARED = ("HALT", "SEND", "RECV", "OUTB", "OUTH")  # what a core of an array does not do alone
_WRAPPED = f"(v + {HIGH + 1} & {2 * HIGH + 1}) - {HIGH + 1}"
_TESTS = {
    "BZ": "r[{s}] == 0",
    "BNZ": "r[{s}] != 0",
    "BLT": "r[{s}] < r[{d}]",
    "BBS": "r[{s}] >> {bit} & 1",
    "BBC": "not r[{s}] >> {bit} & 1",
}


def may_part(one: Instruction) -> bool:
    """Return whether it ends a stretch: it branches, or a core that was taken over stops in front of it."""
    return "l" in one.op.takes or one.name in SHARED


def source(program: Program, first: int, *, single: bool = False) -> tuple[str, int]:
    """Return statements from a word on to the first one that may part (or of that word alone), and the last word
    done."""
    found: list[str] = []
    for word in range(first, len(program.instructions)):
        one = program.instructions[word]
        found += statements(one, word, program.ram_bytes)
        if single or may_part(one):
            return "\n".join([*found, f"return {word + 1}"]), word
    return "\n".join([*found, f"return core._stuck({len(program.instructions)})"]), len(program.instructions)


def statements(one: Instruction, word: int, ram_bytes: int) -> list[str]:
    """Return one instruction, without what follows it."""
    if one.name in ALU_SPELLED:
        value = _value(one)
        expression = re.sub(
            r"\b[ab]\b", lambda name: f"r[{one.rs}]" if name[0] == "a" else value, ALU_SPELLED[one.name]
        )
        if one.name not in WRAPPING:
            return [f"r[{one.rd}] = {expression}"]
        # nearly always in range, and then Python's numbers stay short
        low, high = WORD_LIMITS
        return [f"v = {expression}", f"r[{one.rd}] = v if {low} <= v <= {high} else {WRAP.format('v')}"]
    if "m" in one.op.takes:
        return _memory(one, word, ram_bytes)
    if "l" in one.op.takes:
        return _branch(one, word)
    d, s = f"r[{one.rd}]", f"r[{one.rs}]"
    return {
        "HALT": [f"return core._halt({word})"],
        "RDT": [
            f"if core._read == len(core._port): core._no_timestamp({word})",
            f"{d} = core._port[core._read]",
            "core._read += 1",
        ],
        "ID": [f"{d} = core._place"],
        "MOV": [f"{d} = {_value(one)}"],
        "SATB": _saturate(d, s, 0, BYTE_LIMIT),
        "SATH": _saturate(d, s, LOW, HIGH),
        "OUTB": _leave(word, s, 0, BYTE_LIMIT),
        "OUTH": _leave(word, s, LOW, HIGH),
        "SEND": [f"return core._link({word})"],
        "RECV": [f"return core._link({word})"],
    }[one.name]


def _value(one: Instruction) -> str:
    return f"({one.value})" if one.constant or "n" in one.op.takes else f"r[{one.value}]"


def _saturate(d: str, s: str, low: int, high: int) -> list[str]:
    return [
        f"v = {s}",
        f"if not {low} <= v <= {high}:",
        "    core._saturations += 1",
        f"    v = min(max(v, {low}), {high})",
        f"{d} = v",
    ]


def _leave(word: int, s: str, low: int, high: int) -> list[str]:
    return [
        f"if core._attached_to_array: return core._not_yet({word})",
        f"if not {low} <= {s} <= {high}: core._wraps += 1",
        f"core.out.append(({s} - {low}) % {high - low + 1} + {low})",
    ]


def _memory(one: Instruction, word: int, ram_bytes: int) -> list[str]:
    """Return the operand's cell `i`, checked unless it is a good constant, and what is done there."""
    d, size, last = f"r[{one.rd}]", one.op.size, ram_bytes - one.op.size
    cells = "ram" if size == 1 else "halves"
    if one.constant and 0 <= one.value <= last and one.value % size == 0:
        found = [f"i = {one.value // size}"]
    else:
        found = [f"i = {one.value}" if one.constant else f"i = r[{one.rs}] + {one.value}"]
        found.append(f"if not 0 <= i <= {last}: core._outside({word}, i, {last})")
        found += [f"if i & 1: core._odd({word}, i)", "i >>= 1"] if size == 2 else []
    sign = "-" if one.name == "SUBM" else "+"
    added = [
        f"v = {cells}[i] {sign} {d}",
        f"if not {LOW} <= v <= {HIGH}:",
        "    core._wraps += 1",
        f"    v = {_WRAPPED}",
        f"{cells}[i] = v",
    ]
    return (
        found
        + {
            "LDB": [f"{d} = {cells}[i]"],
            "LDBS": [f"v = {cells}[i]", f"{d} = v - (v >> 7 << 8)"],
            "LDH": [f"{d} = {cells}[i]"],
            "STB": [f"if not -128 <= {d} <= {BYTE_LIMIT}: core._wraps += 1", f"{cells}[i] = {d} & {BYTE_LIMIT}"],
            "STH": [f"v = {d}", f"if not {LOW} <= v <= {2 * HIGH + 1}: core._wraps += 1", f"{cells}[i] = {_WRAPPED}"],
            "ADDM": added,
            "SUBM": added,
        }[one.name]
    )


def _branch(one: Instruction, word: int) -> list[str]:
    if one.name in _TESTS:
        test = _TESTS[one.name].format(s=one.rs, d=one.rd, bit=one.bit)
        return [f"if {test}: return {one.target}"]
    return {
        "JMP": [f"return {one.target}"],
        "BNT": [f"if core._read == len(core._port): return core._waits({word}, {one.target})"],
        "BFE": [f"if core._read == len(core._port): return core._over({word}, {one.target})"],
    }[one.name]
