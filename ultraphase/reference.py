"""One core's instructions executed one after the other: read this first, then `ultraphase.core` and `ultraphase.array`.

Fixed-width NumPy scalars and a structured view of RAM, nothing shared with the package's engines. No links between
cores. Only tests and benches import this module.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ultraphase.assembly.isa import Instruction

COMPUTES = ("ADD", "SUB", "MUL", "AND", "OR", "XOR", "MIN", "MAX", "MOV", "SHL", "SHR", "SAR")


def _computed(one: Instruction, a: np.int32, other: np.int32) -> np.int32:
    """Return what an instruction of COMPUTES makes of its two operands; overflow wraps."""
    shift = np.int32(one.value)
    match one.name:
        case "ADD" | "SUB" | "MUL":
            arithmetic = {"ADD": np.add, "SUB": np.subtract, "MUL": np.multiply}[one.name]
            return np.int32(arithmetic(a, other, dtype=np.int32))
        case "AND" | "OR" | "XOR":
            bitwise = {"AND": np.bitwise_and, "OR": np.bitwise_or, "XOR": np.bitwise_xor}[one.name]
            return np.int32(bitwise(a, other))
        case "MIN" | "MAX":
            return min(a, other) if one.name == "MIN" else max(a, other)
        case "SHL":
            return np.int32(np.left_shift(a, shift))
        case "SHR":
            return (np.array([a], np.int32).view(np.uint32) >> np.uint32(one.value)).view(np.int32)[0]
        case "SAR":
            return np.int32(np.right_shift(a, shift))
    return other  # MOV


def _is_taken(one: Instruction, a: int, b: int, empty: bool) -> bool:
    """Return whether a branch is taken; `empty`: no photon waits at the port."""
    bit = a >> one.bit & 1
    taken = {"BNT": empty, "BFE": empty, "JMP": True, "BZ": a == 0, "BNZ": a != 0, "BLT": a < b}
    return (taken | {"BBS": bit == 1, "BBC": bit == 0})[one.name]


def interpret(
    instructions: Sequence[Instruction], timestamps: Sequence[int], ram_bytes: int
) -> dict[str, int | list[int]]:
    """Run a program until it halts.

    Parameters
    ----------
    instructions : in the order of the program store
    timestamps : what the port delivers, photon by photon
    ram_bytes : size of RAM, which starts at zero

    Returns
    -------
    registers `r`, bytes of `ram`, words sent `out`, instructions done `n`, 16-bit and 8-bit wraps `w`, saturations `s`
    """
    r, ram, out = np.zeros(16, np.int32), np.zeros(ram_bytes, np.uint8), list[int]()
    halves, port, at, done, wraps, saturations = ram.view(np.int16), list(timestamps), 0, 0, 0, 0
    with np.errstate(over="ignore"):
        while True:
            one = instructions[at]
            done, at = done + 1, at + 1
            other = np.int32(one.value) if one.constant else r[one.value & 15]
            cell = (one.value if one.constant else int(r[one.rs]) + one.value) if "m" in one.op.takes else 0
            match one.name:
                case "HALT":
                    return {"r": r.tolist(), "ram": ram.tolist(), "out": out, "n": done, "w": wraps, "s": saturations}
                case name if name in COMPUTES:
                    r[one.rd] = _computed(one, r[one.rs], other)
                case "SATB" | "SATH":
                    info = np.iinfo(np.uint8 if one.name == "SATB" else np.int16)
                    held = np.clip(r[one.rs], info.min, info.max)
                    saturations += int(held != r[one.rs])
                    r[one.rd] = held
                case "LDB" | "LDBS" | "LDH":
                    size = 2 if one.name == "LDH" else 1
                    r[one.rd] = ram.view({"LDB": "u1", "LDBS": "i1", "LDH": "i2"}[one.name])[cell // size]
                case "STB":
                    value = int(r[one.rd])
                    ram[cell] = value & 255
                    wraps += value not in (int(ram[cell]), int(ram.view(np.int8)[cell]))
                case "STH":
                    value = int(r[one.rd])
                    halves[cell // 2] = np.int32(value).astype(np.int16)
                    wraps += value not in (int(halves[cell // 2]), int(halves[cell // 2]) & 0xFFFF)
                case "ADDM" | "SUBM":
                    exact = int(halves[cell // 2]) + (1 if one.name == "ADDM" else -1) * int(r[one.rd])
                    halves[cell // 2] = np.int64(exact).astype(np.int16)
                    wraps += exact != int(halves[cell // 2])
                case "OUTB" | "OUTH":
                    kind = np.uint8 if one.name == "OUTB" else np.int16
                    out.append(int(r[one.rs].astype(kind)))
                    wraps += out[-1] != int(r[one.rs])
                case "RDT":
                    r[one.rd] = port.pop(0)
                case "ID":
                    r[one.rd] = 0
                case _:
                    taken = _is_taken(one, int(r[one.rs]), int(r[one.rd]), not port)
                    at = one.target if taken else at


def add_photons(histogram: Sequence[int], table: np.ndarray) -> list[int]:
    """Add a row of `table` (timestamps, numbers) for every photon of one pixel's histogram, without a limit."""
    sums = [0] * table.shape[1]
    for timestamp, photons in enumerate(histogram):
        for _ in range(int(photons)):
            sums = [held + int(added) for held, added in zip(sums, table[timestamp], strict=True)]
    return sums
