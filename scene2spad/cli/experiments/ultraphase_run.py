"""`ultraphase run`: one frame of an array of cores, what it cost, and how one core did it."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace

import numpy as np

from scene2spad.cli.experiments.ultraphase_inputs import Photons, photons_of, program_of, tables_of
from scene2spad.cli.experiments.ultraphase_steps import explain_failure, look_at_core
from scene2spad.options.experiments import Ultraphase
from scenes.errors import InputError, require
from scenes.progress import Progress
from ultraphase import CoreArray, Program
from ultraphase.array import Frame
from ultraphase.power import Cost, Load, frame_end, power

log = logging.getLogger(__name__)

_MAX_TRACED = 100_000


def run_frame(command: Ultraphase, progress: Progress) -> dict:
    """Run one frame and return what leaves the cores, and what it cost: 2 x 2 cores, or one behind each pixel of a
    histogram."""
    program, chosen = program_of(command)
    family = chosen.family if chosen else ""
    require(family not in ("learned", "addressed"), f"{program.name}: has no frame of 2 x 2 pixels to run")
    require(0 <= command.trace <= _MAX_TRACED, f"--trace {command.trace} is outside 0 to {_MAX_TRACED}")
    if command.watch:
        program.region(command.watch)  # refused where there is none
    photons = photons_of(command, program, chosen.block if chosen else (1, 1))
    tables = tables_of(command, program, chosen, photons.shape)
    array = CoreArray(program, photons.shape, tables)
    try:
        frame = array.frame(photons.timestamps, photons.offsets)
    except InputError as error:
        for line in explain_failure(command, array, tables, photons, str(error)):
            log.warning("%s", line)
        raise
    result = _measured(program, tables, photons, frame)
    return result | look_at_core(command, array, tables, photons)


def _measured(program: Program, tables: dict[str, np.ndarray], photons: Photons, frame: Frame) -> dict:
    cores = photons.shape[0] * photons.shape[1]
    read, sent = frame.counters.photons, int(photons.offsets[-1])
    if read < sent:
        log.warning(
            "warning: %s halted with %d of %d photons unread: costs are of those read",
            *(program.name, sent - read, sent),
        )
    cost = _cost(program, tables, photons.shape, frame)
    return {
        "program": program.name,
        "words": len(program.words),
        "ram_bits": program.ram_bits,
        "cores": list(photons.shape),
        "counters": asdict(frame.counters),
        "clocks_per_photon": cost.clocks_per_photon if read else None,
        "frame_end_clocks": cost.clocks_per_frame,
        "stall_clocks": int(frame.stalls.sum()),
        "out_bits": int(frame.out_bits.sum()),
        "out": frame.out.tolist(),
        "power_30_fps": asdict(power(cost, Load(read / cores, pixels=cores))),
    }


def _cost(program: Program, tables: dict[str, np.ndarray], shape: tuple[int, int], frame: Frame) -> Cost:
    """Return the cost of a frame: its end is all of a frame without photons, the rest its photons'."""
    cores = shape[0] * shape[1]
    photons, bits = frame.counters.photons, frame.out_bits.sum() / cores
    clocks = float((frame.cycles - frame.stalls).sum())
    try:
        end = frame_end(program, shape, tables)
        require(cores * end.clocks_per_frame <= clocks, f"{program.name} takes longer without photons")
    except InputError as reason:  # such as a program that reads without asking whether a photon is there
        log.warning("warning: all clocks of the frame are counted as its photons': %s", reason)
        end = Cost(0, 0, 0)
    per_photon = (clocks - cores * end.clocks_per_frame) / photons if photons else 0.0
    return replace(end, clocks_per_photon=per_photon, bits_per_pixel=bits)
