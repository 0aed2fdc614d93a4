"""The instruction set: what each instruction takes, does and costs, and its 32-bit word.

UltraPhase-constrained, not UltraPhase's own (that one is not public): see `chip.ASSUMPTIONS`. Registers hold signed
32-bit values. A word is, from the top: 6 bits opcode, 4 bits rd, 4 bits rs, 1 bit "constant", 17 bits value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scenes.errors import require

REGISTERS = 16
DIRECTIONS = ("north", "east", "south", "west")
STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # (row, column) of the neighbour in that direction
VALUE_BITS = 17
BYTE_LIMIT = 255
HALF_LIMITS = (-(1 << 15), (1 << 15) - 1)
_TARGET_BITS = 9


@dataclass(frozen=True)
class Op:
    """One kind of instruction.

    takes   its operands in order: d destination, s source, t second source register, v register or constant,
            n shift amount, b bit number, l label, m RAM operand [base + constant], x direction
    reads, writes   RAM accesses, of `size` bytes
    """

    name: str
    takes: str
    does: str
    reads: int = 0
    writes: int = 0
    size: int = 0


OPS: tuple[Op, ...] = (
    Op("HALT", "", "the frame is done; the next one starts at word 0, RAM kept"),
    Op("BNT", "l", "branch if no timestamp is there"),
    Op("BFE", "l", "branch if the frame is over and its timestamps are read"),
    Op("JMP", "l", "jump"),
    Op("BZ", "sl", "branch if zero"),
    Op("BNZ", "sl", "branch if not zero"),
    Op("BLT", "stl", "branch if the first is less than the second, signed"),
    Op("BBS", "sbl", "branch if the bit is set"),
    Op("BBC", "sbl", "branch if the bit is clear"),
    Op("RDT", "d", "read the timestamp"),
    Op("ID", "d", "place of the core: bit 0 parity of its column, bit 1 of its row"),
    Op("MOV", "dv", "move"),
    Op("ADD", "dsv", "add, 32 bits, wraps"),
    Op("SUB", "dsv", "subtract"),
    Op("AND", "dsv", "and"),
    Op("OR", "dsv", "or"),
    Op("XOR", "dsv", "exclusive or"),
    Op("MUL", "dsv", "low 32 bits of the product"),
    Op("MIN", "dsv", "the smaller, signed"),
    Op("MAX", "dsv", "the larger, signed"),
    Op("SHL", "dsn", "shift left"),
    Op("SHR", "dsn", "shift right, zeros come in"),
    Op("SAR", "dsn", "shift right, the sign comes in"),
    Op("SATB", "ds", "saturate to 0 .. 255, counted where it does"),
    Op("SATH", "ds", "saturate to -32768 .. 32767, counted where it does"),
    Op("LDB", "dm", "load a byte, unsigned", reads=1, size=1),
    Op("LDBS", "dm", "load a byte, signed", reads=1, size=1),
    Op("LDH", "dm", "load 16 bits, signed", reads=1, size=2),
    Op("STB", "mt", "store the low byte, counted where that loses value", writes=1, size=1),
    Op("STH", "mt", "store the low 16 bits, counted where that loses value", writes=1, size=2),
    Op("ADDM", "mt", "add to 16 bits in RAM, wraps, counted where it does", reads=1, writes=1, size=2),
    Op("SUBM", "mt", "subtract from 16 bits in RAM, wraps, counted where it does", reads=1, writes=1, size=2),
    Op("SEND", "xs", "send to a neighbour; wait while the link is full"),
    Op("RECV", "dx", "receive from a neighbour; wait while the link is empty"),
    Op("OUTB", "s", "8 bits leave the sensor"),
    Op("OUTH", "s", "16 bits leave the sensor"),
)
BY_NAME = {op.name: op for op in OPS}
_OPERANDS = {
    "d": "rd",
    "s": "rs",
    "t": "rt",
    "v": "rv or #constant",
    "n": "#amount",
    "b": "#bit",
    "l": "label",
    "m": "[address]",
    "x": "direction",
}
_CODE = {op.name: code for code, op in enumerate(OPS)}


def operands(op: Op) -> str:
    """Return what an instruction takes, as its reference writes it: `rd, rs, rv or #constant`."""
    return ", ".join(_OPERANDS[kind] for kind in op.takes)


_HALF, _MASK = 1 << 31, (1 << 32) - 1

# Expressions of two operands a and b that take Python ints and int64 arrays alike: one definition for the array, which
# calls them, and for the core, which compiles them. Results of WRAPPING ones are brought back to 32 bits by WRAP.
ALU_SPELLED: dict[str, str] = {
    "ADD": "a + b",
    "SUB": "a - b",
    "AND": "a & b",
    "OR": "a | b",
    "XOR": "a ^ b",
    "MUL": "a * b",
    "MIN": "b + (a - b) * (a < b)",
    "MAX": "b + (a - b) * (a > b)",
    "SHL": "a << b",
    "SHR": f"(a & {_MASK}) >> b",
    "SAR": "a >> b",
}
WRAPPING = ("ADD", "SUB", "MUL", "SHL", "SHR")
WORD_LIMITS = (-_HALF, _HALF - 1)
WRAP = f"({{}} + {_HALF} & {_MASK}) - {_HALF}"
ALU: dict[str, Callable[[Any, Any], Any]] = {
    name: eval("lambda a, b: " + (WRAP.format(f"({expression})") if name in WRAPPING else expression))
    for name, expression in ALU_SPELLED.items()
}


@dataclass(frozen=True)
class Instruction:
    """One instruction. Fields that its operands do not use are zero.

    constant   v is a constant, or the RAM operand has no base register
    value      constant, register number of v, shift amount, RAM offset or direction
    target, bit   of branches
    """

    name: str
    rd: int = 0
    rs: int = 0
    constant: bool = False
    value: int = 0
    target: int = 0
    bit: int = 0

    @property
    def op(self) -> Op:
        return BY_NAME[self.name]


def encode(instruction: Instruction) -> int:
    """Return the 32-bit word."""
    takes = instruction.op.takes
    value = instruction.bit << _TARGET_BITS | instruction.target if "l" in takes else instruction.value
    low = value & (1 << VALUE_BITS) - 1
    head = _CODE[instruction.name] << 26 | instruction.rd << 22 | instruction.rs << 18
    return head | instruction.constant << VALUE_BITS | low


def decode(word: int) -> Instruction:
    """Return the instruction of a word. Raises InputError for a word that no instruction has."""
    code, rd, rs = word >> 26, word >> 22 & 15, word >> 18 & 15
    require(0 <= word < 1 << 32 and code < len(OPS), f"word {word:#010x}: no such opcode")
    constant, low = bool(word >> VALUE_BITS & 1), word & (1 << VALUE_BITS) - 1
    op = OPS[code]
    if "l" in op.takes:
        target, bit = low & (1 << _TARGET_BITS) - 1, low >> _TARGET_BITS
        found = Instruction(op.name, rd, rs, constant, target=target, bit=bit)
    else:
        signed = low - (low >> VALUE_BITS - 1 << VALUE_BITS)
        found = Instruction(op.name, rd, rs, constant, value=signed)
    require(encode(found) == word and _plain(found), f"word {word:#010x}: fields of {op.name} that it has no use for")
    return found


def _plain(instruction: Instruction) -> bool:
    """Return whether unused fields are zero and used ones in range, so that a word has one spelling."""
    takes = instruction.op.takes
    checks = (
        instruction.rd == 0 or "d" in takes or "t" in takes,
        instruction.rs == 0 or "s" in takes or ("m" in takes and not instruction.constant),
        not instruction.constant or "v" in takes or "m" in takes,
        instruction.value == 0 or any(kind in takes for kind in "vnmx"),
        "v" not in takes or instruction.constant or 0 <= instruction.value < REGISTERS,
        "n" not in takes or 1 <= instruction.value <= 31,
        "x" not in takes or 0 <= instruction.value < len(DIRECTIONS),
        instruction.bit == 0 or ("b" in takes and instruction.bit < 32),
    )
    return all(checks)


def format_instruction(instruction: Instruction, label: Callable[[int], str] = str) -> str:
    """Return as the assembler reads it; `label` names the target of a branch."""
    i = instruction
    base = "" if i.constant else f"r{i.rs} + "
    words = {
        "d": f"r{i.rd}",
        "t": f"r{i.rd}",
        "s": f"r{i.rs}",
        "v": f"#{i.value}" if i.constant else f"r{i.value}",
        "n": f"#{i.value}",
        "b": f"#{i.bit}",
        "l": label(i.target),
        "m": f"[{base}{i.value}]",
        "x": DIRECTIONS[i.value & 3],
    }
    return f"{i.name} {', '.join(words[kind] for kind in i.op.takes)}".rstrip()
