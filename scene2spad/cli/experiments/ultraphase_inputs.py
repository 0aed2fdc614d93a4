"""Read what `ultraphase` takes: a program, the contents of its tables, and the photons of a frame."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene2spad.emulation.program_tables import fixed_spatial, int8_temporal
from scene2spad.options.common import only_for
from scene2spad.options.experiments import Ultraphase
from scenes.errors import InputError, require
from scenes.files import read_array
from scenes.random_streams import Stream
from ultraphase import Method, Program, assemble_file, method
from ultraphase.assembly.program import KINDS
from ultraphase.catalog import FAMILIES, TIMESTAMPS

MAX_PHOTONS = 20_000  # of a core
MAX_CORES = 4096
USUAL_SIGNAL = 50.0
LINKS = ("SEND", "RECV")


class Photons(NamedTuple):
    """Photons of one frame: of core c of an array of rows x columns are timestamps[offsets[c]:offsets[c + 1]]."""

    shape: tuple[int, int]
    timestamps: np.ndarray
    offsets: np.ndarray

    def of_core(self, core: int) -> np.ndarray:
        """Return the timestamps of one core."""
        return self.timestamps[self.offsets[core] : self.offsets[core + 1]]


def program_of(command: Ultraphase) -> tuple[Program, Method | None]:
    """Return the program of a name or of a source file."""
    if not command.program.endswith(".s"):
        require(not command.define, "constants by --define are for source files")
        far = re.fullmatch(r"([a-z]+)-(\d{5,40})", command.program)  # more codes than a name can have
        many = far is not None and far[1] in FAMILIES
        chosen = Method(far[1], int(far[2])) if far is not None and many else method(command.program)
        return chosen.program(), chosen
    constants = {}
    for text in command.define:
        found = re.fullmatch(r"([A-Za-z_]\w*)=(-?\d{1,9})", text)
        if found is None:
            raise InputError(f"--define {text!r}: expected NAME=VALUE with a whole number")
        require(found[1] not in constants, f"--define {text}: {found[1]} is given twice")
        constants[found[1]] = int(found[2])
    return assemble_file(Path(command.program), constants), None


def tables_of(
    command: Ultraphase, program: Program, chosen: Method | None, shape: tuple[int, int] | None
) -> dict[str, np.ndarray]:
    """Return the contents of a program's tables for an array of cores, or for one core alone (None): of a program of
    the package its own."""
    if chosen is not None and shape is not None:
        require(not command.table, f"{chosen.name} has its tables; contents by --table are for source files")
        weights = fixed_spatial(chosen)
        if weights is not None:
            weights = np.tile(weights, (shape[0] // chosen.block[0], shape[1] // chosen.block[1], 1))
        return chosen.tables(int8_temporal(chosen), weights)
    tables: dict[str, np.ndarray] = {}
    for text in command.table:
        name, equals, file = text.partition("=")
        good = bool(name and equals and file)
        require(good, f"--table {text!r}: expected NAME=FILE.npy with the name of a .table of the source")
        require(name not in tables, f"--table {text}: {name} is given twice")
        tables[name] = _table(program, name, Path(file), shape)
    return tables


def _table(program: Program, name: str, path: Path, shape: tuple[int, int] | None) -> np.ndarray:
    region = program.region(name)
    require(region.table, f"--table {name}: {name} is RAM that {program.name} writes (.space), expected a .table")
    values = read_array(path)
    shapes = [(region.count,), *([] if shape is None else [(*shape, region.count)])]
    good = values.dtype.kind in "iu" and values.shape in shapes
    more = ": one core is verified" if shape is None else f", or {shapes[1]} for each core its own"
    what = f"whole numbers of shape ({region.count},){more}"
    require(good, f"{path}: {values.dtype} {values.shape} for table {name} of {program.name}, expected {what}")
    limits = np.iinfo(KINDS[region.kind])
    low, high = int(values.min()), int(values.max())
    inside = limits.min <= low and high <= limits.max
    require(inside, f"{path}: values {low} to {high}, expected {limits.min} to {limits.max} for {region.kind} {name}")
    return values


def photons_of(command: Ultraphase, program: Program, block: tuple[int, int]) -> Photons:
    """Return the photons of a frame: of a file, or made up; `block` of cores puts out one result."""
    if command.timestamps is not None:
        made_up = "the made-up return, which --timestamps replaces"
        only_for(command, "ultraphase run", {"photons": (False, made_up), "signal": (False, made_up)})
        if command.timestamps.suffix.lower() == ".npy":
            return _alike(_stream(command.timestamps))
        return _of_histogram(command.timestamps, program, block)
    require(len(command.photons) == 1, f"ultraphase run: {len(command.photons)} photon counts, expected one")
    photons = command.photons[0]
    require(0 <= photons <= MAX_PHOTONS, f"--photons {photons:g} is outside 0 to {MAX_PHOTONS}")
    signal = min(USUAL_SIGNAL, photons) if command.signal is None else command.signal
    require(
        0 <= signal <= photons, f"--signal {signal:g} is outside 0 to {photons:g}, all photons of a pixel (--photons)"
    )
    for option, count in (("photons", photons), ("signal", signal)):
        require(float(count).is_integer(), f"--{option} {count:g}: expected a whole number, as one frame is run")
    return _in_order((2, 2), [_made_up(photons, signal, command.seed, core) for core in range(4)])


def _in_order(shape: tuple[int, int], streams: list[np.ndarray]) -> Photons:
    return Photons(shape, np.concatenate(streams), np.concatenate([[0], np.cumsum([len(one) for one in streams])]))


def _alike(stream: np.ndarray) -> Photons:
    return _in_order((2, 2), [stream] * 4)


def _made_up(photons: float, signal: float, seed: int, core: int) -> np.ndarray:
    """Timestamps of one core in the order of detection: `signal` around bin 300 + 100 core, the rest uniform."""
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.EMULATE, core)))
    near = np.rint(random.normal(300 + 100 * core, 1.4, int(signal))).astype(np.int64)
    rest = random.integers(0, TIMESTAMPS, int(photons) - int(signal))
    return random.permutation(np.concatenate([near, rest]) % TIMESTAMPS)


def _stream(path: Path) -> np.ndarray:
    stamps = read_array(path)
    whole = stamps.ndim == 1 and stamps.dtype.kind in "iu"
    require(whole, f"{path}: {stamps.dtype} {stamps.shape}, expected timestamps as whole numbers of shape (N,)")
    require(len(stamps) <= MAX_PHOTONS, f"{path}: {len(stamps)} photons, expected at most {MAX_PHOTONS} a core")
    if len(stamps):
        low, high = int(stamps.min()), int(stamps.max())
        inside = low >= 0 and high < TIMESTAMPS
        require(inside, f"{path}: timestamps {low} to {high}, expected 0 to {TIMESTAMPS - 1}, those of the chip")
    return stamps.astype(np.int64)


def _of_histogram(path: Path, program: Program, block: tuple[int, int]) -> Photons:
    """Return a core behind each pixel; its photons come in the order of their time bins."""
    from scene2spad.cli.opening import open_histogram

    histogram = open_histogram(path)
    rows, columns, bins = histogram.counts.shape
    size = f"{path}: {rows} x {columns} pixels"
    around = "its period spans them all (`sense --bins 1024` gives such bins)"
    require(bins == TIMESTAMPS, f"{path}: {bins} time bins, expected the chip's {TIMESTAMPS} timestamps: {around}")
    require(rows * columns <= MAX_CORES, f"{size}, expected at most {MAX_CORES}, a core behind each")
    if block != (1, 1):
        whole = rows % block[0] == 0 and columns % block[1] == 0
        require(whole, f"{size} do not divide into the blocks of {block[0]} x {block[1]} cores of {program.name}")
    if any(one.name in LINKS for one in program.instructions):
        enough = rows >= 2 and columns >= 2
        require(enough, f"{size}, expected 2 x 2 or more for {program.name}, whose cores send to their neighbours")
    timestamps, offsets = histogram.timestamps()
    most = int(np.diff(offsets).max())
    require(most <= MAX_PHOTONS, f"{path}: {most} photons in one pixel, expected at most {MAX_PHOTONS}")
    return Photons((rows, columns), timestamps.astype(np.int64), offsets)
