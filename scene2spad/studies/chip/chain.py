"""A trained code on emulated cores: every photon of a view, what leaves the sensor, and depth by the network."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
import torch

from csph.codes.quantise import Int8Rule
from csph.networks.posterior import Decoder
from scene2spad.emulation.emulated_chain import timestamps_of
from scene2spad.studies.chip.code import ChipModel, codes_by_torch, leave_sensor
from scenes.errors import require
from scenes.random_streams import Stream
from spad.estimators.bistatic import radial_depth_of
from spad.measurements.histogram import Histogram
from ultraphase import CoreArray
from ultraphase.catalog import TIMESTAMPS
from ultraphase.compiler import Compiled
from ultraphase.core import Counters
from ultraphase.frame_end import require_compiled_end
from ultraphase.power import Cost, cost_of
from ultraphase.verify import Tabulated, verify

_CORES = 1 << 16  # emulated at a time
_TRIAL_PHOTONS = 550


@dataclass(frozen=True, eq=False)
class ChipFrame:
    """Output of the cores for a view: codes (H / Mr, W / Mc, numbers) int64, and the cost of their computation."""

    codes: np.ndarray
    counters: Counters


def core_tables(compiled: Compiled, row: int = 0, column: int = 0) -> dict[str, np.ndarray]:
    """Return tables of one core of a block."""
    tables = compiled.tables(compiled.block)
    return {name: values if values.ndim == 1 else values[row, column] for name, values in tables.items()}


def measured(compiled: Compiled) -> Cost:
    """Return clocks and bits of a compiled code on emulated cores."""
    tables = compiled.tables(compiled.block)
    return cost_of(compiled.program, compiled.block, core_tables(compiled), tables, compiled.chip)


def interpret(counts: np.ndarray, compiled: Compiled) -> ChipFrame:
    """Return one frame of a view, every photon a timestamp that a core's program works on. counts (H, W, 1024)
    integers."""
    height, width = counts.shape[:2]
    rows = max(_CORES // width // compiled.block[0], 1) * compiled.block[0]
    parts, counters = [], []
    for top in range(0, height, rows):
        part = counts[top : top + rows]
        array = CoreArray(compiled.program, part.shape[:2], compiled.tables(part.shape[:2]), chip=compiled.chip)
        frame = array.frame(*timestamps_of(part))
        parts.append(frame.out.reshape(part.shape[0] // compiled.block[0], width // compiled.block[1], -1))
        counters.append(frame.counters)
    return ChipFrame(np.concatenate(parts), reduce(add, counters))


@dataclass(frozen=True, eq=False)
class FastCores:
    """A compiled code as its proven table: the integers of `interpret`, at the speed of a matrix product.

    proofs   by core of a block, (Mr, Mc); cores with the same tables share one
    """

    compiled: Compiled
    proofs: tuple[tuple[Tabulated, ...], ...]

    @classmethod
    def of(cls, compiled: Compiled) -> FastCores:
        """Prove every core's program equal to its integer matrix, and the end of a block's frame to its weighted sum.
        Raises InputError where it is not."""
        rows, columns = compiled.block
        alike = compiled.code.temporal.ndim == 2
        found: dict[tuple[int, int], Tabulated] = {}
        for row in range(rows):
            for column in range(columns):
                core = (0, 0) if alike else (row, column)
                if core not in found:
                    tables = core_tables(compiled, *core)
                    stays, matrix = compiled.code.counters, compiled.matrix[core]
                    found[core] = verify(compiled.program, matrix, tables, chip=compiled.chip, saturates=stays)
                found[row, column] = found[core]
        require_compiled_end(compiled)
        return cls(compiled, tuple(tuple(found[r, c] for c in range(columns)) for r in range(rows)))

    def frame(self, counts: np.ndarray) -> tuple[np.ndarray, int]:
        """Return codes (H / Mr, W / Mc, numbers) of counts (H, W, 1024), and how many of the cores' sums do not fit."""
        rows, columns = self.compiled.block
        tiled = counts.shape[0] % rows == 0 and counts.shape[1] % columns == 0
        size = f"image of {counts.shape[1]} x {counts.shape[0]} pixels"
        require(tiled, f"{size} does not divide into the blocks of {columns} x {rows} cores")
        held = np.empty((*counts.shape[:2], self.compiled.matrix.shape[2]), np.int64)
        over = 0
        for row, proofs in enumerate(self.proofs):
            for column, proof in enumerate(proofs):
                part = counts[row::rows, column::columns]
                sums = proof.sums(part.reshape(-1, TIMESTAMPS))
                over += proof.overflowed(sums)
                held[row::rows, column::columns] = sums.reshape(*part.shape[:2], -1)
        return leave_sensor(held, self.compiled), over


def trial(compiled: Compiled, seed: int) -> dict[str, int]:
    """Return one block of cores, 550 photons each, 50 of them in one return: numbers that differ from the torch
    path's."""
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.TRIAL,)))
    rows, columns = compiled.block
    counts = random.poisson((_TRIAL_PHOTONS - 50) / TIMESTAMPS, (rows, columns, TIMESTAMPS)).astype(np.int32)
    counts[..., random.integers(TIMESTAMPS)] += 50
    found = interpret(counts, compiled)
    return {
        "photons": found.counters.photons,
        "wraps": found.counters.wraps,
        "saturations": found.counters.saturations,
        "differs_from_torch": int(np.count_nonzero(found.codes != codes_by_torch(counts, compiled))),
    }


@torch.no_grad()
def network_depth(chip: ChipModel, codes: np.ndarray, decoder: Decoder | None = None) -> np.ndarray:
    """Return depth (H, W) float32 [m] that the model's own network finds from what left the sensor.

    The integers are scaled to the model's codes, zero-normalised, and back-projected with the chip's tensor.
    """
    count = chip.compiled.code.codes
    numbers = torch.from_numpy(codes).view(*codes.shape[:2], -1, count).permute(3, 2, 0, 1)[None]
    return chip.reader.depth_of_codes(numbers.float() * chip.scale, decoder)[0].numpy()


@dataclass(frozen=True, eq=False)
class ChipDepth:
    """Depth by way of the chip: all photons through the cores, codes in 16 bits, the model's network behind them."""

    chip: ChipModel
    fast: FastCores

    @classmethod
    def of(cls, chip: ChipModel) -> ChipDepth:
        return cls(chip, FastCores.of(chip.compiled))

    def depth_of(
        self,
        histogram: Histogram,
        *,
        int8: bool = False,
        int8_rule: Int8Rule = "calibrated",
        decoder: Decoder | None = None,
    ) -> tuple[np.ndarray, int]:
        """Return depth map (H, W) float32 [m], and how many of the cores' sums wrapped; always in 8 bits.

        Raises InputError for another sensor's histogram, and an image that blocks do not tile.
        """
        self.chip.model.check_histogram(histogram)
        codes, over = self.fast.frame(histogram.counts)
        return radial_depth_of(histogram, network_depth(self.chip, codes, decoder)), over
