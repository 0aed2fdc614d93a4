"""The front of S.2, measured: depth error against power, bytes a frame and clocks a photon, and photons that are lost.

Every design that fits the chip is run at every number of photons: trained ones are decoded by their own networks,
coarse histograms by correlation. Power is that of the instructions, in both readings of the published energy
(`ultraphase.power`), and of the readout. A core that is busy loses photons: by the queue's closed form at every rate,
and by emulation with arrival times at S.2's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from render.transient import Transient
from scene2spad.emulation.emulated_chain import by_torch, decode
from scene2spad.networks.published import PUBLISHED as PUBLISHED_ERRORS
from scene2spad.networks.registry import ModelSpec, Trained
from scene2spad.studies.chip.chain import ChipDepth, core_tables, measured
from scene2spad.studies.chip.code import compile_model
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.estimators.depth import histogram_errors
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor
from ultraphase import ChipSpec, Method, Program, method
from ultraphase.arrivals import TimedCore, lost_fraction, poisson_arrivals
from ultraphase.catalog import PUBLISHED, SPADS
from ultraphase.power import MICRO, Cost, Load, measured_cost, power

PHOTONS = (50.0, 160.0, 550.0, 1600.0, 5000.0)  # a pixel and frame, ten of background for each signal photon
FRAME_RATES = (30.0, 100.0, 300.0, 1000.0)
HEADLINE = (550.0, 30.0)  # photons and frames a second of S.2
LOST_LIMIT = 0.01  # of the photons: a design keeps up where it loses fewer
_EMULATED_PHOTONS = 50_000  # at least, of each point that is emulated with arrival times
_COARSE = ("coarse-16", "coarse-64", "coarse-256")
_PRINTED = {
    "fourier-8": ("fourier", (1024, 1, 1), 128),
    "fourier-16": ("fourier", (1024, 1, 1), 64),
    "separable-8": ("fourier+learned", (256, 2, 2), 128),
    "separable-16": ("fourier+learned", (256, 2, 2), 64),
}


@dataclass(frozen=True, eq=False)
class Design:
    """A design on the chip: what it costs, clocks of its timestamps, one core's program and tables, and the way to
    depth: by a network behind the chip, or a coarse histogram's correlation."""

    name: str
    codes: int
    cost: Cost
    clocks: np.ndarray
    program: Program
    tables: dict[str, np.ndarray]
    chip: ChipDepth | None = None
    coarse: Method | None = None

    def depth_m(self, histogram: Histogram) -> np.ndarray:
        """Return depth (H, W) [m] from the integers that leave the sensor."""
        if self.chip is not None:
            return self.chip.depth_of(histogram)[0]
        assert self.coarse is not None  # what has no codes counts coarsely
        return decode(by_torch(histogram.counts, self.coarse), self.coarse, histogram.sensor)


def designs(models: Mapping[ModelSpec, Trained]) -> list[Design]:
    """Return trained designs, compiled for the chip, and coarse histograms."""
    found = []
    for wanted, trained in models.items():
        chip = ChipDepth.of(compile_model(trained.model, wanted.name))
        compiled, clocks = chip.chip.compiled, chip.fast.proofs[0][0].clocks
        codes, parts = compiled.code.codes, (compiled.program, core_tables(compiled))
        found.append(Design(f"{wanted.label}, K = {codes}", codes, measured(compiled), clocks, *parts, chip))
    for name in _COARSE:
        one = method(name)
        cost = measured_cost(one, None)
        clocks = np.array([cost.clocks_per_photon])
        title = f"coarse histogram, K = {one.codes}"
        found.append(Design(title, one.codes, cost, clocks, one.program(), {}, coarse=one))
    return found


def front_rows(found: list[Design], transient: Transient, seed: int, progress: Progress) -> list[dict[str, object]]:
    """Return a row for every design, number of photons and frame rate: error, power of a pixel, bytes, clocks, lost
    photons.

    `processing_uw_*` are of the photons alone, as in `ultraphase.power.sweep`. The energy of the frame's end stands
    beside them in `frame_end_uw_energy`. The error is that of a frame whose photons are all read; `keeps_up` says where
    that is so.
    """
    rows = []
    for number, photons in enumerate(PHOTONS):
        histogram = sense(transient, Sensor(), PhotonBudget(photons / 11, photons * 10 / 11), seed=seed)
        for one in found:
            progress(f"{one.name}, {photons:g} photons", number / len(PHOTONS))
            depth = one.depth_m(histogram)
            errors = histogram_errors(depth, histogram)
            figures = {key: errors[key] for key in ("mae_mm", "median_abs_mm")}
            common: dict[str, object] = {"name": one.name, "photons": photons, **figures}
            rows += [{**common, **costs_of(one, photons, rate)} for rate in FRAME_RATES]
    return rows


def costs_of(one: Design, photons: float, frames_per_s: float) -> dict[str, float]:
    """Return the columns of `front_rows` that need no depth: power of a pixel [uW], bytes, clocks, lost photons."""
    spent = power(one.cost, Load(photons, frames_per_s, pixels=1))
    alone, shared = (lost(one.clocks, photons * spads * frames_per_s) for spads in (1, SPADS))
    return {
        "frames_per_s": frames_per_s,
        "bytes_per_pixel": one.cost.bits_per_pixel / 8,
        "clocks_per_photon": one.cost.clocks_per_photon,
        "processing_uw_published": MICRO * spent.processing_published_w,
        "processing_uw_energy": MICRO * spent.processing_energy_w,
        "frame_end_uw_energy": MICRO * spent.frame_end_energy_w,
        "readout_uw": MICRO * spent.readout_w,
        "lost": alone,
        "lost_16_spads": shared,
        "keeps_up": alone < LOST_LIMIT,
        "keeps_up_16_spads": shared < LOST_LIMIT,
    }


def lost(clocks: np.ndarray, photons_per_s: float) -> float:
    """Return share of a core's photons that come while it is busy, by the closed form."""
    return lost_fraction(photons_per_s * ChipSpec().clock_s, clocks)


def most_photons_per_s(clocks: np.ndarray, limit: float = LOST_LIMIT) -> float:
    """Return the photon rate of a core at which it loses `limit` of them, by bisection of the closed form."""
    low, high = 1.0, 1e9
    for _ in range(60):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if lost(clocks, middle) < limit else (low, middle)
    return low


def loss_rows(found: list[Design], seed: int, progress: Progress) -> list[dict[str, object]]:
    """Return photons lost at S.2's photons and frame rate, a SPAD a core and 16, emulated with arrival times and in
    closed form; and the rates at which LOST_LIMIT of them are lost."""
    rows, chip = [], ChipSpec()
    photons, frames_per_s = HEADLINE
    for number, one in enumerate(found):
        progress(f"{one.name}: arrival times", number / len(found))
        core = TimedCore(one.program, one.tables, chip=chip)
        row: JsonObject = {"name": one.name, "clocks_per_photon": one.cost.clocks_per_photon}
        for spads in (1, SPADS):
            rate = photons * spads * frames_per_s * chip.clock_s
            clocks = poisson_arrivals(rate, int(_EMULATED_PHOTONS / rate), seed)
            stamps = np.random.default_rng(seed).integers(0, chip.timestamps, len(clocks))
            frame = core.timed_frame(clocks, stamps, int(_EMULATED_PHOTONS / rate), drain=False)
            name = "one_spad" if spads == 1 else "16_spads"
            row |= {f"arrived_{name}": frame.arrived, f"emulated_{name}": frame.lost_fraction}
            row[f"closed_form_{name}"] = lost_fraction(rate, one.clocks)
        row["photons_per_s_at_limit"] = most_photons_per_s(one.clocks)
        row["photons_per_frame_and_spad_at_limit"] = row["photons_per_s_at_limit"] / frames_per_s
        row["photons_per_frame_and_spad_at_limit_16"] = row["photons_per_s_at_limit"] / frames_per_s / SPADS
        rows.append(row)
    return rows


def printed_rows() -> list[dict[str, object]]:
    """Return the published points: power from printed clocks, and the MAE that was printed for the design (8 pairs, 16
    levels, without the chip's 8 bits). The published table has no frame end."""
    rows = []
    for name, (design, block, compression) in _PRINTED.items():
        row, error = PUBLISHED[name], PUBLISHED_ERRORS[design, block][compression]
        spent = power(Cost(row.clocks, 0, 8 * row.bytes_per_pixel), Load(*HEADLINE, pixels=1))
        rows.append(
            {
                "name": name,
                "mae_mm": error.near_mae,
                "bytes_per_pixel": row.bytes_per_pixel,
                "clocks_per_photon": row.clocks,
                "processing_uw_published": MICRO * spent.processing_published_w,
                "processing_uw_energy": MICRO * spent.processing_energy_w,
                "readout_uw": MICRO * spent.readout_w,
                "published": asdict(row),
            }
        )
    return rows
