"""Interpret programs a second time, from the text of docs/ultraphase-instructions.md: Python's integers, one
instruction after the other, cores in turn. Nothing of the package is used, not even its fields of an instruction."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

Core = dict  # r, ram, port, at, out, place, clock; free: when each side's word was taken last
_LOADS, _STORES = ("LDB", "LDBS", "LDH"), ("STB", "STH", "ADDM", "SUBM")
_STEPS = {"north": (-1, 0), "east": (0, 1), "south": (1, 0), "west": (0, -1)}
_OTHER = {"north": "south", "south": "north", "east": "west", "west": "east"}
_DOES: dict[str, Callable[[int, int], int]] = {
    "ADD": lambda a, b: a + b,
    "SUB": lambda a, b: a - b,
    "AND": lambda a, b: a & b,
    "OR": lambda a, b: a | b,
    "XOR": lambda a, b: a ^ b,
    "MUL": lambda a, b: a * b,
    "MIN": min,
    "MAX": max,
    "SHL": lambda a, b: a << b,
    "SHR": lambda a, b: a % (1 << 32) >> b,
    "SAR": lambda a, b: a >> b,
}


class Stuck(Exception):
    """The program does what no program may: it leaves its RAM, reads a photon that is not there, or never ends."""


def signed(value: int, bits: int) -> int:
    """Return the low bits of a number, read with sign."""
    return (value + (1 << bits - 1)) % (1 << bits) - (1 << bits - 1)


class SecondCores:
    """rows x columns cores. `lines` are instructions as text, with numbers of words in place of labels; `image` is RAM
    (cores, bytes), all that the program declares."""

    def __init__(self, lines: Sequence[str], shape: tuple[int, int], image: np.ndarray) -> None:
        self.code = [(line.split()[0], re.findall(r"\[.*?\]|[^\s,\[\]]+", line)[1:]) for line in lines]
        self.shape = shape
        self.cores: list[Core] = [
            {"r": [0] * 16, "ram": bytearray(image[n].tobytes()), "place": (n // shape[1], n % shape[1])}
            for n in range(shape[0] * shape[1])
        ]

    def frame(self, stamps: Sequence[Sequence[int]], most: int = 1 << 20) -> list[list[tuple[int, int]]]:
        """Return (value, bits) of all words that leave each core. A stamp of -1 is a look at the port in vain before
        the next one, or before the frame's end. Raises Stuck."""
        for core, own in zip(self.cores, stamps, strict=True):
            core.update(port=deque(own), at=0, out=[], done=False, inbox={}, free={}, clock=0)
        steps = 0
        while not all(core["done"] for core in self.cores):
            moved = False
            for core in self.cores:
                while not core["done"] and self._step(core):
                    moved, steps = True, steps + 1
                    if steps > most:
                        raise Stuck("no end")
            if not moved:
                raise Stuck("cores wait for each other")
        return [core["out"] for core in self.cores]

    def _neighbour(self, core: Core, direction: str) -> Core:
        row, column = (a + b for a, b in zip(core["place"], _STEPS[direction], strict=True))
        if not (0 <= row < self.shape[0] and 0 <= column < self.shape[1]):
            raise Stuck("no neighbour")
        return self.cores[row * self.shape[1] + column]

    def _step(self, core: Core) -> bool:
        """Do one instruction, 3 clocks, and wait for the other core before them; False where a link holds it."""
        if core["at"] >= len(self.code):
            raise Stuck("behind the program")
        name, given = self.code[core["at"]]
        if name == "SEND":
            other, side = self._neighbour(core, given[0]), _OTHER[given[0]]
            if side in other["inbox"]:
                return False
            core["clock"] = max(core["clock"], other["free"].get(side, 0))
            other["inbox"][side] = core["r"][int(given[1][1:])], core["clock"] + 3
        elif name == "RECV":
            self._neighbour(core, given[1])
            if given[1] not in core["inbox"]:
                return False
            core["r"][int(given[0][1:])], there = core["inbox"].pop(given[1])
            core["clock"] = max(core["clock"], there)
            core["free"][given[1]] = core["clock"] + 3
        elif name == "HALT":
            core["done"] = True
        else:
            self._alone(core, name, given)
        core["at"] += 1
        core["clock"] += 3
        return True

    def _alone(self, core: Core, name: str, given: list[str]) -> None:
        r = core["r"]

        def value(text: str) -> int:
            return int(text[1:]) if text[0] == "#" else r[int(text[1:])]

        if name[0] == "B" or name == "JMP":
            taken = {
                "BNT": lambda: not core["port"] or core["port"][0] < 0,
                "BFE": lambda: not core["port"],
                "JMP": lambda: True,
                "BZ": lambda: value(given[0]) == 0,
                "BNZ": lambda: value(given[0]) != 0,
                "BLT": lambda: value(given[0]) < value(given[1]),
                "BBS": lambda: value(given[0]) >> value(given[1]) & 1 == 1,
                "BBC": lambda: value(given[0]) >> value(given[1]) & 1 == 0,
            }[name]()
            if name == "BNT" and taken and core["port"]:
                core["port"].popleft()
            core["at"] = int(given[-1]) - 1 if taken else core["at"]
        elif name in ("OUTB", "OUTH"):
            word = value(given[0])
            core["out"].append((word % 256, 8) if name == "OUTB" else (signed(word, 16), 16))
        elif name in (*_LOADS, *_STORES):
            self._memory(core, name, given)
        else:
            r[int(given[0][1:])] = self._computed(core, name, [value(text) for text in given[1:]])

    @staticmethod
    def _computed(core: Core, name: str, of: list[int]) -> int:
        if name == "RDT":
            if not core["port"] or core["port"][0] < 0:
                raise Stuck("no timestamp")
            return core["port"].popleft()
        if name == "ID":
            return core["place"][1] % 2 + 2 * (core["place"][0] % 2)
        if name in ("SATB", "SATH"):
            low, high = (0, 255) if name == "SATB" else (-(1 << 15), (1 << 15) - 1)
            return min(max(of[0], low), high)
        return of[0] if name == "MOV" else signed(_DOES[name](*of), 32)

    @staticmethod
    def _memory(core: Core, name: str, given: list[str]) -> None:
        stores = name in _STORES
        place, other = given if stores else given[::-1]
        terms = re.findall(r"-?\w+", place.replace("+ -", "-").replace("- ", "-"))
        at = sum(core["r"][int(term[1:])] if term[0] == "r" else int(term) for term in terms)
        size, register, ram = (1 if name in ("LDB", "LDBS", "STB") else 2), int(other[1:]), core["ram"]
        if not 0 <= at <= len(ram) - size or at % size:
            raise Stuck("address")
        held = int.from_bytes(ram[at : at + size], "little", signed=name in ("LDBS", "LDH", "ADDM", "SUBM"))
        if not stores:
            core["r"][register] = held
            return
        own = core["r"][register]
        new = {"ADDM": held + own, "SUBM": held - own}.get(name, own)
        ram[at : at + size] = (new % (1 << 8 * size)).to_bytes(size, "little")
