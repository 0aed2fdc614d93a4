"""`study tdc`: what a real time-to-digital converter costs depth, and what correcting its codes brings back.

Every view is sensed once a clock, with the same photons. A histogram can be recalibrated afterwards; a compressive code
sums rows of C by codes as they come, so that a correction stands before the sum (a line or a table a pixel) or within
it (each pixel's own rows), or the network is trained with it. Methods are compared with themselves behind a perfect
clock, in pairs by view and level.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes

from csph.codes.design import Design
from csph.evaluation.metrics import image_errors, paired_difference
from csph.networks.model import DepthModel
from scene2spad.networks.lookup import obtain
from scene2spad.networks.registry import ModelSpec, Trained
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, rendered
from scene2spad.networks.training import classical
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import plain_log, plt, save
from scene2spad.plots.style import look
from scene2spad.studies.chip.chain import ChipDepth
from scene2spad.studies.chip.code import compile_model
from scene2spad.studies.chip.study import interval_in_words
from scene2spad.studies.tdc.plan import (
    CLOCKS,
    DELAY,
    FILTER,
    FOLDED,
    PERFECT,
    REAL,
    TEST_SET,
    TRAINED,
    WITHIN,
    Plan,
    plan_of,
    sensor_of,
)
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.tdc import clock_error, recalibrated

SENSED = tuple(clock for clock in CLOCKS if clock not in (DELAY, FOLDED, TRAINED))
ALONE = (PERFECT, REAL)  # drawn by their errors, not by their difference from the perfect clock
LINEAR = 10  # differences [%] up to here are drawn on a linear scale, larger ones on a logarithmic one
CHIP = ", int8 on the chip"
FIGURES = ("mae_mm", "within_10mm")
CODE_BITS = 8  # of an entry of C
FORMAT = 2  # of results kept from run to run: another number forgets them


class Recorded(NamedTuple):
    """What a sensor recorded: the histogram, and counts on equal bins where they were spread over true time."""

    histogram: Histogram
    spread: np.ndarray | None = None

    @property
    def counts(self) -> np.ndarray:
        return self.histogram.counts if self.spread is None else self.spread


class Subject(NamedTuple):
    """A method: depth (H, W) of what was recorded, the clocks it is measured behind, and bits of its C a pixel, as it
    stands (`stored`) and with rows of the pixel's own (`folded`); None for a histogram, which needs neither."""

    name: str
    depth_of: Callable[[Recorded], np.ndarray]
    clocks: tuple[str, ...]
    stored: int | None
    folded: int | None
    digest: str  # that results are kept by


def run(command: Study, progress: Progress) -> dict:
    """Measure every method behind every clock; tables, a figure and JSON in `command.out`."""
    plan, folder = plan_of(command.preset), command.out / command.preset
    models = obtain(plan.wanted, command, progress)
    subjects = [*_networks(plan, models.found), *map(_classical, plan.classical)]
    test = rendered(TEST_SET, folder / "sets", count=plan.views, size=plan.size, progress=progress)
    rows = measured(Store(folder / "results"), subjects, test, plan, command.seed, progress)
    compared = compared_rows(rows, subjects)
    numbers: JsonObject = {
        **models.described(),
        "preset": command.preset,
        "views": len(test.views.transients),
        "levels": plan.levels,
        "clocks": clock_rows(),
        "compared": compared,
    }
    made = [
        write_csv(rows, command.out / "tdc.csv"),
        write_csv(compared, command.out / "tdc-compared.csv"),
    ]
    path = command.out / "tdc.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    figure = draw(compared, command.out / "tdc.png")
    shown = numbers if command.json else _in_words(numbers)
    return {**shown, "figures": [str(figure)], "csv": [str(one) for one in made], "numbers": str(path)}


def clock_rows() -> list[JsonObject]:
    """Return mean and rms error of each clock [ps], bin width included, and the bits of its correction a pixel."""
    rows = []
    for clock in SENSED:
        sensor = sensor_of(clock)
        assert sensor.code_edges is not None and sensor.tdc is not None
        mean, rms = (part * sensor.bin_width_s * 1e12 for part in clock_error(sensor.code_edges))
        bits = sensor.tdc.bits_per_pixel
        rows.append({"clock": clock, "mean_ps": mean, "rms_ps": rms, "correction_bits": bits, "what": CLOCKS[clock]})
    return rows


@torch.no_grad()
def _by_network(model: DepthModel, recorded: Recorded) -> np.ndarray:
    counts = torch.from_numpy(np.ascontiguousarray(recorded.counts.transpose(2, 0, 1), np.float32))
    return model.depth_m(counts[None, None])[0].numpy()


def _by_chip(chip: ChipDepth, recorded: Recorded) -> np.ndarray:
    return chip.depth_of(recorded.histogram)[0]


def _networks(plan: Plan, found: dict[ModelSpec, Trained]) -> list[Subject]:
    """Networks behind the sensed clocks and with folded rows; tuned ones behind the real clock, as another clock of the
    same method; one design on the emulated chip."""
    tuned = {one.plain: found[one] for one in plan.tuned if one in found}
    subjects = []
    for one in plan.models:
        if one not in found:
            continue
        model, bits = found[one].model.cpu(), code_bits(found[one].config.model.design)
        kept = found[one].subject.digest
        subjects.append(Subject(one.label, partial(_by_network, model), (*SENSED, FOLDED), *bits, kept))
        if one in tuned:
            own = tuned[one].model.cpu()
            subjects.append(Subject(one.label, partial(_by_network, own), (TRAINED,), *bits, tuned[one].subject.digest))
        if one == plan.on_chip:
            compiled = compile_model(model, one.name)
            chip, digest = ChipDepth.of(compiled), compiled.digest(kept)
            subjects.append(Subject(f"{one.label}{CHIP}", partial(_by_chip, chip), SENSED, *bits, digest))
    return subjects


def _digest(*parts: object) -> str:
    return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()


def _classical(name: str) -> Subject:
    method, sensor = classical(name), Sensor()

    def depth_of(recorded: Recorded) -> np.ndarray:
        return method(torch.from_numpy(np.ascontiguousarray(recorded.counts, np.float32)), sensor).numpy()

    clocks = (*SENSED, FOLDED)
    if name == FILTER:
        return Subject(f"{name}, all bins", depth_of, clocks, None, None, _digest(name))
    code, _, number = name.rpartition("-")
    design = Design.named(code, (sensor.bins, 1, 1), codes=int(number), compression=None, full=False)
    return Subject(f"{code} 1024x1x1 K{number}, correlation", depth_of, clocks, *code_bits(design), _digest(name))


def code_bits(design: Design | None) -> tuple[int | None, int | None]:
    """Return bits of C that a pixel's own core holds: as the design stores it, and with rows of the pixel's own.

    Computed codes (Fourier: a quarter wave) become a table then. Of spatial weights a core holds its own K.
    """
    if design is None:
        return None, None
    spatial = design.codes if design.has_spatial else 0
    rows = design.codes * design.block[0]
    stored = rows if design.computed is None else design.computed
    return CODE_BITS * (stored + spatial), CODE_BITS * (rows + spatial)


def recorded_by_clock(test: TestSet, view: int, level: tuple[float, float], seed: int) -> dict[str, Recorded]:
    """Sense a view once behind each clock, the same photons; `folded` and `trained` are the real one's."""
    transient, budget = test.views.transients[view], PhotonBudget(*level)
    draw = int(np.random.SeedSequence((seed, view, *(round(1000 * part) for part in level))).generate_state(1)[0])
    found = {clock: Recorded(sense(transient, sensor_of(clock), budget, seed=draw)) for clock in SENSED}
    real = found[REAL].histogram
    height, width = real.counts.shape[:2]
    converter, edges = real.sensor.converter_map(height, width, draw), real.sensor.code_edges
    assert converter is not None and edges is not None
    return {**found, FOLDED: Recorded(real, recalibrated(real.counts, converter, edges)), TRAINED: Recorded(real)}


def measured(
    store: Store, subjects: Sequence[Subject], test: TestSet, plan: Plan, seed: int, progress: Progress
) -> list[JsonObject]:
    """Return a row a method, clock, view and level: MAE [mm] and the share within 10 mm. What the store has is not
    computed again."""
    rows, total = [], len(test.views.transients) * len(plan.levels)
    for view, scene in enumerate(test.views.scenes):
        for number, level in enumerate(plan.levels):
            progress(f"{scene}, {level[0]:g} + {level[1]:g}", (view * len(plan.levels) + number) / total)
            key = {"view": f"{view}-{test.digests[view]}", "level": level, "seed": seed, "format": FORMAT}
            recorded: dict[str, Recorded] = {}
            for subject in subjects:
                asked = {**key, "method": subject.name, "clocks": subject.clocks}
                kept = store.get(subject.digest, **asked)
                if kept is None:
                    recorded = recorded or recorded_by_clock(test, view, level, seed)
                    kept = errors_by_clock(subject, recorded, test.truth_m(view))
                    store.put(subject.digest, kept, **asked)
                named = {"view": f"{view}-{scene}", "signal": level[0], "background": level[1]}
                rows += [{"method": subject.name, "clock": one["clock"], **named, **one} for one in kept]
    return rows


def errors_by_clock(subject: Subject, recorded: dict[str, Recorded], truth: np.ndarray) -> list[JsonObject]:
    """Return a row a clock of one method, view and level.

    No code of the real clock carries a detection over the laser period's end. So a depth below the mean delay that is
    taken off is 0, and not at the period's end.
    """
    rows, delay_m, range_m = [], mean_delay_m(), sensor_of(REAL).range_m
    for clock in subject.clocks:
        depth = subject.depth_of(recorded[clock])[: truth.shape[0], : truth.shape[1]]
        estimates = {clock: depth} | ({DELAY: np.maximum(depth - delay_m, 0)} if clock == REAL else {})
        for name, estimate in estimates.items():
            errors = image_errors(estimate, truth, range_m)
            rows.append({"clock": name, **{figure: errors[figure] for figure in FIGURES}})
    return rows


def mean_delay_m() -> float:
    """Return the depth [m] that the real clock's codes are late by, over all pixels and times."""
    sensor = sensor_of(REAL)
    assert sensor.code_edges is not None
    return clock_error(sensor.code_edges).mean * sensor.bin_depth_m


def compared_rows(rows: Sequence[JsonObject], subjects: Sequence[Subject]) -> list[JsonObject]:
    """Return a row a method and clock: means, the paired difference of MAE from the perfect clock as a fraction of its
    MAE with its 95 % interval over views, and bits a pixel. `holds` where the interval's end is at most WITHIN."""
    sensed = {row["clock"]: row["correction_bits"] for row in clock_rows()}
    found = []
    for method in dict.fromkeys(one.name for one in subjects):
        mine = [one for one in subjects if one.name == method]
        perfect = _by_view(rows, method, PERFECT, "mae_mm")
        mae = float(np.mean([np.mean(v) for v in perfect.values()]))
        for clock in dict.fromkeys(row["clock"] for row in rows if row["method"] == method):
            values = _by_view(rows, method, clock, "mae_mm")
            apart = paired_difference(values, perfect)
            fraction, low, high = (part / mae for part in apart)
            stored = mine[0].folded if clock == FOLDED else mine[0].stored
            within = _by_view(rows, method, clock, "within_10mm")
            found.append(
                {
                    "method": method,
                    "clock": clock,
                    "mae_mm": float(np.mean([np.mean(v) for v in values.values()])),
                    "within_10mm": float(np.mean([np.mean(v) for v in within.values()])),
                    "difference": fraction,
                    "low": low,
                    "high": high,
                    "holds": bool(high <= WITHIN) if math.isfinite(high) else None,
                    "clock_bits": sensed.get(clock, 0),
                    "code_bits": 0 if stored is None else stored,
                }
            )
    return found


def _by_view(rows: Sequence[JsonObject], method: str, clock: str, figure: str) -> dict[str, np.ndarray]:
    found: dict[str, list[float]] = {}
    for row in rows:
        if (row["method"], row["clock"]) == (method, clock):
            found.setdefault(row["view"], []).append(row[figure])
    return {view: np.array(values) for view, values in found.items()}


def draw(compared: Sequence[JsonObject], path: Path) -> Path:
    """Draw MAE of every method behind every clock, and the difference from the perfect clock where codes are
    corrected."""
    methods = [*dict.fromkeys(row["method"] for row in compared)]
    figure, panels = plt.subplots(1, 2, figsize=(13, 1.7 + 0.55 * len(methods)), layout="constrained", sharey=True)
    beyond = 100 * WITHIN
    for number, clock in enumerate(CLOCKS):
        mine = [row for row in compared if row["clock"] == clock]
        place = np.array([methods.index(row["method"]) for row in mine]) + (number - 3) * 0.12
        panels[0].plot([row["mae_mm"] for row in mine], place, ms=5, label=clock, **look(number) | {"ls": ""})
        if clock in ALONE:
            continue
        middle = np.array([100 * row["difference"] for row in mine])
        ends = np.array([[100 * row[end] for row in mine] for end in ("low", "high")])
        bars = np.abs(ends - middle) if len(mine) else np.zeros((2, 0))
        panels[1].errorbar(middle, place, xerr=bars, ms=4, lw=1, **look(number) | {"ls": ""})
        beyond = max(beyond, np.nanmax(np.abs([*ends, middle]), initial=0.0))
    plain_log(panels[0], "x")
    panels[0].set(xlabel="mean absolute depth error [mm]", yticks=range(len(methods)), yticklabels=methods)
    panels[0].invert_yaxis()
    panels[1].axvline(100 * WITHIN, color="k", lw=1, ls=":")
    panels[1].axvline(0, color="k", lw=0.8)
    _symmetric(panels[1], beyond)
    panels[1].set_title(f"without {' and '.join(ALONE)}, which stand in the left panel alone", fontsize=9)
    for axes in panels:
        axes.grid(alpha=0.3, axis="x")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    return save(figure, path)


def _symmetric(axes: Axes, beyond: float) -> None:
    """Make the axis of differences [%] linear within LINEAR and logarithmic beyond, with a tick wherever it reaches."""
    axes.set_xscale("symlog", linthresh=LINEAR)
    low, high = axes.get_xlim()
    half = [0, 5, *(digit * 10**power for power in range(1, 9) for digit in (1, 2, 5))]
    ticks = sorted({sign * tick for tick in half for sign in (-1, 1) if low <= sign * tick <= high})
    if beyond > 100 * LINEAR:  # 2 and 5 of each decade would lie on one another
        ticks = [tick for tick in ticks if abs(tick) < LINEAR or str(abs(tick))[0] == "1"]
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.set_xlabel(
        f"error more than behind a perfect clock [%], 95 % interval (dotted: {WITHIN:.0%})\n"
        f"linear to ±{LINEAR} %, logarithmic beyond"
    )


def _in_words(numbers: JsonObject) -> JsonObject:
    lines = [
        f"{row['method']}, {row['clock']}: {row['mae_mm']:.1f} mm, {row['within_10mm']:.1%} within 10 mm, "
        f"{row['difference']:+.1%} ({interval_in_words(row['low'], row['high'], 1, 'view')}), "
        f"{row['clock_bits']} + {row['code_bits']} bits a pixel"
        for row in numbers["compared"]
    ]
    clocks = [f"{row['clock']}: mean {row['mean_ps']:+.1f} ps, rms {row['rms_ps']:.1f} ps" for row in numbers["clocks"]]
    return {"compared": lines, "clocks": clocks, "absent": numbers["absent"] or ["none"]}
