"""Numbers of `study depth-offset` from rows of errors and from codes: ratios, breaks, energies. No drawing here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from csph.codes.temporal import bin_energy, grouped_energy
from csph.evaluation.methods import LEVEL_GROUPS, Evaluation, Row
from csph.layer import make_coding
from scene2spad.networks.registry import ModelSpec, Trained
from spad.sensor.model import Sensor

# Decided before any model of the study was trained: the geometric mean over seeds and over 64x and 128x of
# MAE(7 m farther in time) / MAE(as it is), MAE over all scenes and the levels RATIO_LEVELS.
LEAST, MOST = "at least", "under"
BARS: dict[tuple[str, tuple[int, int, int]], tuple[str, float]] = {
    ("learned", (1024, 1, 1)): (LEAST, 3.0),
    ("learned", (1024, 4, 4)): (LEAST, 3.0),
    ("learned", (256, 4, 4)): (MOST, 2.0),
}
RATIO_LEVELS = ((10.0, 10.0), (10.0, 200.0), (50.0, 50.0), (10.0, 1000.0))
RATIO_COMPRESSIONS = (64, 128)
ENERGY_BAR = 0.5  # of the long learned codes, beyond the training depths over inside
PULSE_SIGMAS = 3.0  # that a pulse reaches beyond its arrival
BREAKS_AT = 2.0  # times the error of the set as it is


class Energy(NamedTuple):
    """Mean square of a temporal code per bin, beyond what training depths and the pulse reach, over that within."""

    name: str
    reach_m: float
    start: float
    trained: float


def mean_error(
    rows: Iterable[Row], name: str, levels: Sequence[tuple[float, float]] | None = None, figure: str = "mae_mm"
) -> float:
    """Return mean over scenes and levels of a figure of one model, all pixels; NaN where it was not measured."""
    found = [
        getattr(row, figure)
        for row in rows
        if row.method == name and row.group == "all" and (levels is None or (row.signal, row.background) in levels)
    ]
    return float(np.nanmean(found)) if found else math.nan


def geometric_mean(values: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(values)))) if len(values) else math.nan


def ratio_rows(near: Sequence[Row], far: Sequence[Row], wanted: Sequence[ModelSpec]) -> list[dict]:
    """Return MAE [mm] near and far of every model and seed at RATIO_LEVELS, and far over near."""
    rows = []
    for one in wanted:
        errors = [mean_error(part, one.name, RATIO_LEVELS) for part in (near, far)]
        common = {"model": one.name, "design": one.label, "compression": one.compression, "seed": one.seed}
        rows.append({**common, "near_mm": errors[0], "far_mm": errors[1], "ratio": errors[1] / errors[0]})
    return rows


def verdicts(ratios: Sequence[dict], wanted: Sequence[ModelSpec]) -> list[dict]:
    """Return each bar: the geometric mean over seeds at each compression, then over compressions, and whether it holds.

    `holds` is None where no model of the design was found.
    """
    by_name = {row["model"]: row["ratio"] for row in ratios}
    found = []
    for (design, block), (sense, limit) in BARS.items():
        mine = [w for w in wanted if (w.design, w.block) == (design, block) and not w.time_offset_m]
        each = {
            ratio: [by_name[w.name] for w in mine if w.compression == ratio and math.isfinite(by_name[w.name])]
            for ratio in RATIO_COMPRESSIONS
        }
        mean = geometric_mean([geometric_mean(values) for values in each.values() if values])
        holds = None if math.isnan(mean) else mean >= limit if sense == LEAST else mean < limit
        label = ModelSpec(design, block).label
        common = {f"{ratio}x": values for ratio, values in each.items()}
        found.append({"design": label, "bar": f"{sense} {limit:g}", "geometric_mean": mean, "holds": holds, **common})
    return found


def summary_rows(rows: Sequence[Row], wanted: Iterable[ModelSpec], common: Mapping[str, object]) -> list[dict]:
    """Return per design and compression, seeds together: mean and 95 % interval over scenes and seeds, by level
    group."""
    evaluation, found = Evaluation(list(rows)), []
    for (label, ratio), members in by_design(wanted).items():
        names = [one.name for one in members]
        for levels in LEVEL_GROUPS:
            line = {"design": label, "compression": ratio, "seeds": len(names), **common, "levels": levels}
            for figure in ("mae_mm", "rmse_mm", "within_10mm"):
                interval = evaluation.interval(names, levels=levels, figure=figure)
                mean, low, high = interval or (math.nan,) * 3
                line |= {figure: mean, f"{figure}_low": low, f"{figure}_high": high}
            found.append(line)
    return found


def by_design(wanted: Iterable[ModelSpec]) -> dict[tuple[str, int], list[ModelSpec]]:
    """Return trainings of one design at one compression by different seeds; without codes the compression is 1."""
    found: dict[tuple[str, int], list[ModelSpec]] = {}
    for one in wanted:
        found.setdefault((one.label, one.compression if one.coded else 1), []).append(one)
    return found


def boundary_bin(reach_m: float, sensor: Sensor) -> int:
    """Return the first bin that no return from up to `reach_m` and none of its pulse falls into."""
    after_m = sensor.response.window_s(PULSE_SIGMAS)[1] * sensor.bin_depth_m / sensor.bin_width_s
    return math.ceil((reach_m + after_m) / sensor.bin_depth_m)


def energy_ratio(energy: np.ndarray, bins: int, boundary: int) -> float:
    """Return mean energy per bin beyond the boundary over that before it; `energy` (G,) over G equal groups of `bins`
    bins."""
    edges = np.linspace(0, bins, len(energy) + 1)
    inside = np.clip((boundary - edges[:-1]) / np.diff(edges), 0, 1)
    return float(np.average(energy, weights=1 - inside) / np.average(energy, weights=inside))


def energy_of(trained: Trained, reach_m: float) -> Energy | None:
    """Return the code's energy ratio as trained and at its random start; None unless a temporal code over all bins is
    learned, and the training depths leave bins free."""
    design, sensor = trained.config.model.design, trained.config.model.sensor
    if design is None or "temporal" not in design.learned or design.block[0] != sensor.bins:
        return None
    boundary = boundary_bin(reach_m, sensor)
    if not 0 < boundary < sensor.bins:
        return None
    start = make_coding(design, sensor, trained.config.seed).temporal
    codes = (start, trained.model.codes_layer.temporal)
    at_start, now = (energy_ratio(bin_energy(code), sensor.bins, boundary) for code in codes)
    return Energy(trained.wanted.name, reach_m, at_start, now)


def energy_history(trained: Trained) -> tuple[np.ndarray, np.ndarray]:
    """Return steps (S,) and energies (S, G) of the code over its training; start and end alone where no log was
    kept."""
    rows = trained.table("energy.csv")
    if rows:
        return np.array([row["step"] for row in rows]), np.array([[*row.values()][1:] for row in rows])
    config = trained.config
    start = make_coding(config.model.codes_design, config.model.sensor, config.seed).temporal
    ends = [grouped_energy(code) for code in (start, trained.model.codes_layer.temporal)]
    return np.array([0, trained.state.get("step", config.steps)]), np.array(ends)


def break_m(offsets_m: Sequence[float], errors_mm: Sequence[float]) -> float | None:
    """Return the least offset at which the error passes BREAKS_AT times that of offset 0, by straight lines between
    offsets; None where it does not."""
    limit = BREAKS_AT * errors_mm[0]
    for i in range(1, len(errors_mm)):
        if errors_mm[i] > limit:
            fraction = (limit - errors_mm[i - 1]) / (errors_mm[i] - errors_mm[i - 1])
            return float(offsets_m[i - 1] + max(fraction, 0.0) * (offsets_m[i] - offsets_m[i - 1]))
    return None
