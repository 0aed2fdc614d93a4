"""Time, data rate and power of a program: Supplementary Figure 5, as published and as energy times rate.

Two readings of one number. The authors' script says 94.6 GOPS/W, so that its inverse, 1.06e-11, is Joules an operation;
S.2 prints it as Watts. With E that number, I instructions a photon, N photons a frame and core, f frames a second and
t = N I / (operations a second) the time that a core works on a frame,

    published   P = E I N cores x f t    (a power, if E were one: scaled by the share of time the core works)
    energy      P = E I N cores x f      (Joules an operation times operations a second)

The two differ by 1 / t, 2,000 to 32,000, and lead to opposite conclusions: readout dominates, or processing does.
That E is an energy rests on the script's comment, and on 10.6 pW being out of proportion for a core clocked at 420 MHz
where E x 140 MOPS = 1.48 mW is not: inference, not the chip's data sheet. Both are reported.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from scenes.errors import normalise_fields, require, require_kind
from scenes.json_types import JsonObject
from ultraphase.array import CoreArray
from ultraphase.assembly.program import Program
from ultraphase.catalog import PUBLISHED, Method
from ultraphase.chip import ChipSpec, chosen_chip

MICRO, KILO = 1e6, 1e-3
READINGS = {
    "published": "E x instructions x duty, as Supplementary Figure 5 prints it (Joules x duty, called Watts)",
    "energy": "E x instructions a second, with E = 1 / 94.6 GOPS/W in Joules (inferred, see ultraphase.power)",
}
# Columns of `sweep` that are of so many frames a second: no core draws or sends them that has no time for its frames
NEEDS_TIME = ("rate_kb_per_s", "processing_uw", "processing_uw_energy", "readout_uw", "frame_end_uw_energy")


@dataclass(frozen=True)
class Load:
    """Load of the sensor: photons a frame and pixel, frames a second, and pixels."""

    photons: float = 550.0
    frames_per_s: float = 30.0
    pixels: int = 4

    def __post_init__(self) -> None:
        normalise_fields(self, "load")
        require(0 <= self.photons <= 1e9, f"load: {self.photons:g} photons a frame and pixel is outside 0 to 1e9")
        require(
            0 < self.frames_per_s <= 1e9,
            f"load: {self.frames_per_s:g} frames a second, expected more than 0, at most 1e9",
        )
        require(1 <= self.pixels <= 1 << 40, f"load: {self.pixels} pixels is outside 1 to 2^40")


@dataclass(frozen=True)
class Cost:
    """A program's clocks and bits.

    clocks_per_photon   mean over timestamps
    clocks_per_frame    a frame without photons, which is its end and what comes before its first photon, mean over the
                        cores of a block: not in the published table
    bits_per_pixel      what leaves the sensor a frame and pixel
    waits_per_frame     clocks more at the frame's end in which a core waits for a neighbour: time, but no energy
    slowest_per_frame   clocks and waits of the block's slowest core, which decides how many frames a second there can
                        be; 0 where all cores take the mean
    """

    clocks_per_photon: float
    clocks_per_frame: float
    bits_per_pixel: float
    waits_per_frame: float = 0.0
    slowest_per_frame: float = 0.0

    @property
    def frame_end_clocks(self) -> float:
        """Return the clocks from a frame's last photon to the next frame's first: of the slowest core of a block."""
        return max(self.slowest_per_frame, self.clocks_per_frame + self.waits_per_frame)


@dataclass(frozen=True)
class Power:
    """Rates and powers under a load. Powers are of all pixels together, in Watts as far as the reading is right.

    frame_time_s       what a core works on a frame's photons; processing_* are of these alone
    frame_end_time_s   what the slowest core of a block then works, and waits for neighbours, at the frame's end
    """

    frame_time_s: float
    frame_end_time_s: float
    data_rate_bit_per_s: float
    processing_published_w: float
    processing_energy_w: float
    frame_end_energy_w: float
    readout_w: float


def power(cost: Cost, load: Load, chip: ChipSpec | None = None) -> Power:
    """Return both readings of the processing power (module docstring), and readout power = rate C V^2."""
    require_kind(cost, Cost, "power", " of `measured_cost` or `cost_of`")
    chip = chosen_chip(chip, "power")
    time_s = chip.processing_time_s(load.photons, cost.clocks_per_photon)
    rate = chip.data_rate_bit_per_s(cost.bits_per_pixel, load.pixels, load.frames_per_s)
    energy_per_frame = chip.energy_j(cost.clocks_per_photon * load.photons) * load.pixels
    return Power(
        frame_time_s=time_s,
        frame_end_time_s=chip.processing_time_s(1, cost.frame_end_clocks),
        data_rate_bit_per_s=rate,
        processing_published_w=energy_per_frame * load.frames_per_s * time_s,
        processing_energy_w=energy_per_frame * load.frames_per_s,
        frame_end_energy_w=chip.energy_j(cost.clocks_per_frame) * load.pixels * load.frames_per_s,
        readout_w=chip.readout_power_w(rate),
    )


def measured_cost(method: Method, temporal: np.ndarray | None, chip: ChipSpec | None = None) -> Cost:
    """Return clocks of a program on emulated cores: all timestamps once, and a frame of no photons for its end. That
    neither depends on what is in RAM, `verify` proves.

    temporal   int8 temporal tensor (K, Mt) of the method, None for coarse histograms
    """
    tables = method.tables(temporal)
    return cost_of(method.program(chip), method.block, tables, tables, chip)


def cost_of(
    program: Program,
    block: tuple[int, int],
    core_tables: Mapping[str, np.ndarray],
    block_tables: Mapping[str, np.ndarray],
    chip: ChipSpec | None = None,
) -> Cost:
    """Return `measured_cost` of any program: tables of one core, and of the block of cores whose codes leave as one.

    What a program does before its first photon is part of the frame without photons: a photon's clocks are those from
    where the core waits for it to where it waits for the next. InputError for a program that waits for none.
    """
    count = program.timestamps or (chip or ChipSpec()).timestamps
    photons = CoreArray(program, (1, count), core_tables, chip=chip)
    photons.frame(np.zeros(0, np.int64), np.zeros(count + 1, np.int64), park=True)
    per_photon = photons.frame(np.arange(count), np.arange(count + 1), park=True, resume=True).cycles.mean()
    return replace(frame_end(program, block, block_tables, chip), clocks_per_photon=float(per_photon))


def frame_end(
    program: Program, block: tuple[int, int], tables: Mapping[str, np.ndarray], chip: ChipSpec | None = None
) -> Cost:
    """Return the cost of a frame without photons on a block of cores. InputError for a program that needs one."""
    array = CoreArray(program, block, tables, chip=chip)
    cores = block[0] * block[1]
    frame = array.frame(np.zeros(0, np.int64), np.zeros(cores + 1, np.int64))
    waits = float(frame.stalls.mean())
    works, slowest = float(frame.cycles.mean()) - waits, float(frame.cycles.max())
    return Cost(0.0, works, float(frame.out_bits.sum() / cores), waits, slowest)


def reference_bits(photons: float, chip: ChipSpec | None = None) -> dict[str, float]:
    """Return bits a pixel and frame without any compression: every timestamp, or the full histogram in 8 bits a bin."""
    chip = chosen_chip(chip, "reference_bits")
    return {"raw timestamps": photons * chip.timestamp_bits, "full histogram": chip.timestamps * 8.0}


def table(costs: dict[str, Cost], chip: ChipSpec | None = None) -> list[JsonObject]:
    """Return Supplementary Figure 5, a dictionary a row: printed, recomputed from printed clocks, emulated, residuals.

    costs   emulated cost by the method's name; residual_clocks = emulated - printed
    """
    load = Load()
    rows = []
    for name, printed in PUBLISHED.items():
        again = power(Cost(printed.clocks, 0, printed.bytes_per_pixel * 8), load, chip)
        ours = power(costs[name], load, chip)
        rows.append(
            {
                "name": name,
                "published": asdict(printed),
                "recomputed": _columns(printed.clocks, printed.bytes_per_pixel, again),
                "emulated": {
                    **_columns(costs[name].clocks_per_photon, costs[name].bits_per_pixel / 8, ours),
                    **_end_columns(costs[name], ours),
                },
                "residual_clocks": costs[name].clocks_per_photon - printed.clocks,
            }
        )
    return rows


def _columns(clocks: float, bytes_per_pixel: float, found: Power) -> dict[str, float]:
    """Make the columns of Supplementary Figure 5; processing power in both readings."""
    return {
        "clocks": clocks,
        "bytes_per_pixel": bytes_per_pixel,
        "frame_time_s": found.frame_time_s,
        "rate_kb_per_s": found.data_rate_bit_per_s / 8 * KILO,
        "processing_uw": found.processing_published_w * MICRO,
        "processing_uw_energy": found.processing_energy_w * MICRO,
        "readout_uw": found.readout_w * MICRO,
    }


def _end_columns(cost: Cost, found: Power) -> dict[str, float]:
    """Make the columns of the frame's end, which the published table does not have."""
    return {
        "frame_end_clocks": cost.clocks_per_frame,
        "frame_end_waits": cost.waits_per_frame,
        "frame_end_uw_energy": found.frame_end_energy_w * MICRO,
    }


def sweep(
    costs: dict[str, Cost],
    photons: Iterable[float],
    frame_rates: Iterable[float],
    pixels: Iterable[int],
    chip: ChipSpec | None = None,
) -> list[JsonObject]:
    """Return a row for every program, photon count, frame rate and number of pixels, with the two references beside
    them.

    processing_uw, processing_uw_energy   of the photons alone, as published; the frame's end stands beside them
    busy, keeps_up                        share of the time that the slowest core of a block works: photons and end.
                                          Above 1 no core keeps up: the columns of NEEDS_TIME are then None
    """
    chip, rates, sizes, rows = chip or ChipSpec(), tuple(frame_rates), tuple(pixels), []
    for count in photons:
        bare = {name: Cost(0, 0, bits) for name, bits in reference_bits(count, chip).items()}
        for rate in rates:
            for size in sizes:
                load = Load(count, rate, size)
                for name, cost in {**costs, **bare}.items():
                    found = power(cost, load, chip)
                    busy = (found.frame_time_s + found.frame_end_time_s) * rate
                    rows.append(
                        {"name": name, **asdict(load), "busy": busy, "keeps_up": busy <= 1}
                        | _columns(cost.clocks_per_photon, cost.bits_per_pixel / 8, found)
                        | _end_columns(cost, found)
                        | (dict.fromkeys(NEEDS_TIME) if busy > 1 else {})
                    )
    return rows


def as_csv(rows: list[JsonObject]) -> str:
    """Return flat rows as CSV, nested dictionaries as `outer.inner` columns."""
    flat = []
    for row in rows:
        parts = [({k: v} if not isinstance(v, dict) else {f"{k}.{n}": x for n, x in v.items()}) for k, v in row.items()]
        flat.append({key: value for part in parts for key, value in part.items()})
    text = io.StringIO()
    writer = csv.DictWriter(text, list(flat[0]) if flat else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()
