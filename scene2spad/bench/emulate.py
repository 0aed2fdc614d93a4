"""`bench emulate`: seconds of the emulator's two routes, which must agree bit for bit, and a megapixel frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from scene2spad.emulation.emulated_chain import timestamps_of
from scene2spad.emulation.program_tables import int8_temporal
from scene2spad.options.experiments import Bench
from scenes.errors import require
from scenes.files import write_csv
from scenes.progress import Progress
from scenes.random_streams import Stream
from ultraphase import Core, CoreArray, Method, method, verify
from ultraphase.catalog import PUBLISHED, TIMESTAMPS
from ultraphase.tables import INT8_SCALE, by_block, spatial_sum
from ultraphase.verify import Tabulated

T = TypeVar("T")
MEGAPIXEL = 1 << 20
PHOTONS = 550
_MEGAPIXEL_PROGRAMS = ("fourier-16", "separable-16")
_BLOCK = 1 << 15  # pixels of fresh counts; a megapixel holds them 32 times, each time shifted in time


def run(command: Bench, progress: Progress) -> dict:
    """Run the bench: rows of `name`, `seconds`, `cpu_seconds` (of all threads: what one free core takes), `error`
    (numbers that differ from the interpreted program's) and rates; CSV in `command.out`. `command.quick` leaves out the
    megapixel frames; `command.only` names programs."""
    names = list(command.only) or list(PUBLISHED)
    out = command.out
    require(out.is_dir() or not out.exists(), f"{out}: is a file, expected a folder for the results")
    rows = []
    for number, name in enumerate(names):
        progress(name, number / len(names))
        rows += _one(method(name), command.seed, command.repeats)
    if not command.quick:
        progress("megapixel", 0.9)
        large = [name for name in _MEGAPIXEL_PROGRAMS if name in names]
        rows += [time_megapixel(method(name), command.seed, command.repeats) for name in large]
    out.mkdir(parents=True, exist_ok=True)
    return {"rows": rows, "out": str(write_csv(rows, out / "bench-emulate.csv"))}


def _clocks() -> np.ndarray:
    """Seconds by the clock, and of CPU in all threads."""
    return np.array([time.perf_counter(), time.process_time()])


def _proof(chosen: Method) -> Tabulated:
    temporal = int8_temporal(chosen)
    return verify(chosen.program(), chosen.matrix(temporal), chosen.tables(temporal), saturates=chosen.saturates)


def _counts(pixels: int, seed: int) -> np.ndarray:
    """Poisson counts with a mean of 500 uniform and 50 in three bins, (pixels, 1024) uint8."""
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.EMULATE, pixels)))
    counts = random.poisson((PHOTONS - 50) / TIMESTAMPS, (pixels, TIMESTAMPS)).astype(np.uint8)
    peak = random.integers(1, TIMESTAMPS - 1, pixels)
    for step, fraction in ((-1, 0.25), (0, 0.5), (1, 0.25)):
        counts[np.arange(pixels), peak + step] += random.poisson(50 * fraction, pixels).astype(np.uint8)
    return counts


def _timed(run: Callable[[], T], repeats: int) -> tuple[np.ndarray, T]:
    """Return median clocks of `repeats` warm runs, and what the last returned; the first run is not counted."""
    run()
    spent = []
    for _ in range(max(repeats, 1)):
        start = _clocks()
        found = run()
        spent.append(_clocks() - start)
    return np.median(spent, axis=0), found


def _one(chosen: Method, seed: int, repeats: int) -> list[dict]:
    """One program: a core alone, an array of cores, and its tabulated form, on the same photons."""
    program, tables = chosen.program(), chosen.tables(int8_temporal(chosen))
    rows_columns = (16, 32)
    counts = _counts(rows_columns[0] * rows_columns[1], seed)
    stamps, offsets = timestamps_of(counts.reshape(*rows_columns, -1))
    arrays, frame = _timed(lambda: CoreArray(program, rows_columns, tables).frame(stamps, offsets), repeats)
    proven, proof = _timed(lambda: _proof(chosen), repeats)
    tabulated, sums = _timed(lambda: proof.frame(counts), repeats)

    def run_alone() -> Core:
        core = Core(program, tables)
        core.start(stamps[: offsets[1]], park=True)
        core.run()
        return core

    alone, core = _timed(run_alone, repeats)
    held = np.concatenate([core.contents(region.name) for region in program.state])
    pixels, work, differs = len(counts), frame.counters, _left(chosen, sums) != frame.out
    return [
        _row(f"{chosen.name}: core alone", alone, held != sums[0], 1, core.counters.instructions, offsets[1]),
        _row(f"{chosen.name}: array", arrays, differs, pixels, work.instructions, len(stamps)),
        # a proof that does not hold ends the bench: it has no error to count
        _row(f"{chosen.name}: proof", proven, None, TIMESTAMPS, None, proof.states * TIMESTAMPS),
        _row(f"{chosen.name}: tabulated", tabulated, differs, pixels, None, len(stamps)),
    ]


def _left(chosen: Method, sums: np.ndarray, shape: tuple[int, int] = (16, 32)) -> np.ndarray:
    """Compute the numbers that leave the sensor from those that the cores hold, in the order of the array."""
    if chosen.block == (1, 1):
        return sums
    cores = by_block(sums.reshape(*shape, -1), chosen.block, chosen.codes)
    weights = np.full((cores.shape[2], chosen.codes), INT8_SCALE)
    return spatial_sum(cores, weights).reshape(cores.shape[0] * cores.shape[1], -1)


def _row(
    name: str, spent: np.ndarray, differs: np.ndarray | None, pixels: int, instructions: int | None, photons: int
) -> dict:
    """Return a row of the table: `error` counts integers that differ, None where none are compared."""
    seconds, cpu_seconds = spent.tolist()
    return {
        "name": name,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "error": None if differs is None else int(np.count_nonzero(differs)),
        "pixels": pixels,
        "photons": int(photons),
        "instructions_per_second": None if instructions is None else instructions / seconds,
        "photons_per_second": photons / seconds,
    }


def time_megapixel(chosen: Method, seed: int, repeats: int) -> dict:
    """Time a frame of 2^20 pixels from uint8 histograms by the tabulated form, two threads, the median of `repeats`; a
    block of it is compared with the integer product."""
    import torch  # noqa: F401  # products of bytes are used where it is loaded

    proof, block = _proof(chosen), _counts(_BLOCK, seed)
    histograms = np.concatenate([np.roll(block, shift, axis=1) for shift in range(MEGAPIXEL // _BLOCK)])
    halves = np.array_split(histograms, 2)
    with ThreadPoolExecutor(2) as threads:
        spent, parts = _timed(lambda: list(threads.map(proof.frame, halves)), repeats)
    sums = parts[-1]
    last = halves[-1][-2048:].astype(np.int64) @ proof.table
    photons = int(block.sum(dtype=np.int64)) * (MEGAPIXEL // _BLOCK)
    return _row(
        f"{chosen.name}: megapixel",
        spent,
        proof.limited(last) != sums[-2048:],
        MEGAPIXEL,
        None,
        photons,
    )
