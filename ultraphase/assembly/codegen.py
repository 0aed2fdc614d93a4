"""The assembler text of a compiled code: RAM, what a photon does, and the frame's end."""

from __future__ import annotations

from collections.abc import Iterator

from ultraphase.chip import ChipSpec
from ultraphase.integer_code import IntegerCode


def turns_of(code: IntegerCode) -> Iterator[int]:
    """Yield how often the photon's loop over harmonics may turn, fewest first; 1: there is none. A loop needs
    consecutive harmonics, and an even number of them a turn, as odd and even ones are stepped to differently."""
    yield 1
    count = len(code.harmonics)
    if code.harmonics == tuple(range(1, count + 1)):
        yield from (count // part for part in range(count // 2, 1, -1) if count % part == 0 and part % 2 == 0)


def loop_order(code: IntegerCode, turns: int) -> str:
    """Return how a photon goes through the codes, in words."""
    if not code.harmonics:
        return f"{code.codes} codes one after the other, code-major table of {code.codes} x {code.bins} bytes"
    count, table = len(code.harmonics), f"quarter wave of {code.bins // 4} bytes for all of them"
    if turns == 1:
        return f"{count} harmonics one after the other, {table}"
    return f"{turns} turns of {count // turns} harmonics, {table}"


_REGISTERS = {"p": 1, "t": 2, "u": 3, "c": 4, "i": 5, "a": 6, "b": 7, "last": 9}


def source_of(code: IntegerCode, chip: ChipSpec, turns: int) -> str:
    """Return assembler text: RAM with the sums in front, what a photon does, and the frame's end."""
    blocks, many = chip.timestamps // code.bins, code.block != (1, 1)
    moving = blocks > 1 or turns > 1 or many
    lines = [
        f"; {' '.join(code.name.split())}: {loop_order(code, turns)}",
        "",
        f".equ K, {code.codes}",
        f".equ SUMS, {blocks * code.codes}",
        ".space codes, s16, SUMS",
        *_table_lines(code, many),
        *(f".reg {name}, r{number}" for name, number in _REGISTERS.items()),
        ".reg place, r8" if moving else ".equ place, codes",
        "",
        "loop:   BNT  idle",
        "        RDT  t",
        *(_place(code, chip, blocks) if moving else []),
        *(_photon_of_harmonics(code.harmonics, turns) if code.harmonics else _PHOTON_OF_TABLE),
        "        JMP  loop",
        "",
        "idle:   BFE  end",
        "        JMP  loop",
        "",
        f'.include "{"sumblock" if many else "drain16"}.s"',
    ]
    return "\n".join(lines) + "\n"


def _table_lines(code: IntegerCode, many: bool) -> list[str]:
    if code.harmonics:
        quarter = code.bins // 4
        bit = f".equ BIT, {quarter.bit_length() - 1}                        ; lower of the two bits of the quadrant"
        lines = [f".equ QUARTER, {quarter}", ".table quarter, u8, QUARTER", bit]
    else:
        lines = [f".equ BINS, {code.bins}", ".table temporal, s8, K * BINS"]
    if many:
        weighted, shift = code.spatial is not None, code.output_shift
        lines += [f".equ WEIGHTED, {int(weighted)}", *([".table weight, s8, K"] * weighted), ".table ways, u8, 1"]
        lines += [f".equ SHIFT, {shift}", f".equ HALF, {1 << shift >> 1}"]
    return lines


def _place(code: IntegerCode, chip: ChipSpec, blocks: int) -> list[str]:
    """Write the instructions for place = 2 K (t / Mt), as the sums begin at address 0: as many for every timestamp."""
    if blocks == 1:
        return ["        MOV  place, #codes"]
    bits, lines, of = code.bins.bit_length() - 1, [], "t"
    while bits:
        step = min(bits, chip.max_shift)
        lines.append(f"        SHR  place, {of}, #{step}")
        bits, of = bits - step, "place"
    return [*lines, f"        MUL  place, {of}, #2*K"]


_PHOTON_OF_TABLE = [
    "        AND  t, t, #BINS - 1",
    ".for k in 0..K - 1",
    "        LDBS c, [temporal + BINS*k + t]",
    "        ADDM [place + 2*k], c",
    ".end",
]


def _photon_of_harmonics(harmonics: tuple[int, ...], turns: int) -> list[str]:
    """Write the instructions for every harmonic's phase, as few as possible, then for its cosine and sine."""
    if turns > 1:
        each = len(harmonics) // turns
        return [
            "        ADD  u, t, #1",
            "        MOV  p, #0",
            "        ADD  last, place, #2*K",
            "turn:",
            f".for h in 1..{each}",
            "        .reg step, t + (h + 1) % 2                 ; t for odd h, u = t + 1 for even h",
            "        ADD  p, p, step",
            '.include "harmonic.s"',
            ".end",
            f"        ADD  place, place, #{4 * each}",
            "        BLT  place, last, turn",
        ]
    steps = [_step(before, h) for before, h in zip((0, *harmonics), harmonics, strict=False)]
    lines = ["        ADD  u, t, #1"] if any(line.endswith(" u") for step in steps for line in step) else []
    for number, step in enumerate(steps, start=1):
        lines += [f"        {line}" for line in step]
        lines += [f".for h in {number}..{number}", '.include "harmonic.s"', ".end"]
    return lines


def _step(before: int, h: int) -> list[str]:
    """Write the step from phase p of harmonic `before` (0: of none) to that of h, p = h t + floor(h / 2)."""
    if h == 1:
        return ["MOV  p, t"]
    if before and h - before == 1:
        return [f"ADD  p, p, {'t' if h % 2 else 'u'}"]
    if before and before % 2 == 0 and h == 2 * before:
        return ["SHL  p, p, #1"]
    return [f"MUL  p, t, #{h}", f"ADD  p, p, #{h // 2}"]
