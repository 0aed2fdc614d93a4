"""`study sim-to-real`: calibrate a chip on half of its captures of a plane, and predict the others with the renderer.

Every effect of the sensor is switched off in turn and the rest calibrated again: what likelihood and which error it
buys, by cross-validation within the half calibrated on. Last, distance and tilt of the plane are found from single
captures, and compared with the arm's.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from scene2spad.datasets.zone_captures import (
    PlaneCaptures,
    read_plane_captures,
    shipped_captures,
    within,
    zone_captures,
)
from scene2spad.networks.results import Store
from scene2spad.options.experiments import Study
from scene2spad.studies.sim_to_real import figures
from scene2spad.studies.sim_to_real.measures import Comparison, compare, summary
from scene2spad.studies.sim_to_real.pile_up import HIGH, best_of, draw_pile_up, pile_up_rows
from scene2spad.studies.sim_to_real.plan import FITTED, GEOMETRY, MODEL_ERROR, SENSOR, TRIED, Plan, plan_of
from scene2spad.studies.sim_to_real.pose import Pose, find_pose, model_covariance, nearest_start
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.sensor.files import SensorFile, load_sensor, write_sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.calibration import Calibration, calibrate, calibrated_file
from spad.zones.expected_counts import ZoneCapture
from spad.zones.histogram import zone_grid
from spad.zones.simulation import expected_zone_counts

FORMAT = 1  # of results kept from run to run: another number forgets them
SPANS = ((0.0, 0.05), (0.05, 0.1), (0.1, 0.2), (0.2, 0.4), (0.1, 0.4))  # metres: what is told apart


# of a pose, as rows have them
UNITS = {"distance_mm": 1e3, "about_y_deg": 180 / np.pi, "about_x_deg": 180 / np.pi, "reflectance": 1.0}


@dataclass(frozen=True, eq=False)
class Prediction:
    """Captures and what the calibrated sensor makes of the rendered plane.

    lit       light of each capture, rendered, beside its counts
    used      indices of the captures calibrated on; `held` (N,) bool: the others
    expected  counts (N, Z, T) by the renderer and the calibrated sensor; `errors` against the measured ones
    """

    plan: Plan
    start: SensorFile
    captures: PlaneCaptures
    lit: list[ZoneCapture]
    used: np.ndarray
    fitted: Calibration
    expected: np.ndarray
    errors: Comparison

    @property
    def held(self) -> np.ndarray:
        held = np.ones(len(self.lit), dtype=bool)
        held[self.used] = False
        return held

    @property
    def judged(self) -> np.ndarray:
        """Indices of the captures held out, from the nearest distance calibrated on."""
        return np.flatnonzero(self.held & (self.captures.distance_m >= self.plan.nearest_m))


def run(command: Study, progress: Progress) -> dict:
    """Calibrate, predict, ablate, find poses; tables, figures, a sensor file and JSON in `command.out`."""
    command.out.mkdir(parents=True, exist_ok=True)
    of = predict(plan_of(command.preset), command.seed, progress)
    spans = span_rows(of)
    store, digest = Store(command.out / "results"), digest_of(of)
    ablation = ablated(of, store, digest, progress)
    progress("poses", 0.8)
    # a pose weighs with the model's error as the captures calibrated on show it
    model_error = summary(of.errors, of.used)["model_error"]
    poses = pose_rows(of, store, digest, model_error)
    pile_up = pile_up_rows()
    numbers: JsonObject = {
        "preset": command.preset,
        "captures": {"calibrated_on": len(of.used), "held_out": int(of.held.sum())},
        "prediction": spans,
        "chip": chip_range(within(of.captures, of.plan.nearest_m)),
        "ablation": ablation,
        "pose": {**pose_summary(poses), "model_error": model_error},
        "pile_up": best_of(pile_up),
        "standard_errors": {name: np.asarray(error).tolist() for name, error in of.fitted.errors.items()},
    }
    made = [
        write_csv(_flat(ablation), command.out / "sim-to-real-ablation.csv"),
        write_csv(poses, command.out / "sim-to-real-pose.csv"),
        write_csv(pile_up, command.out / "sim-to-real-pile-up.csv"),
        write_csv(_flat(spans), command.out / "sim-to-real.csv"),
    ]
    path = command.out / "sim-to-real.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    shown = numbers if command.json else in_words(numbers)
    files = {
        "figures": [str(one) for one in draw_all(of, poses, command.out)],
        "csv": [str(one) for one in made],
        "sensor": str(write_calibrated(of, command.out)),
    }
    return {**shown, **files, "numbers": str(path)}


def predict(plan: Plan, seed: int, progress: Progress) -> Prediction:
    """Render the plane at every distance, calibrate on some captures, and predict all."""
    start, captures = load_sensor(SENSOR), read_plane_captures(shipped_captures())
    used = np.flatnonzero(captures.distance_m >= plan.nearest_m)[:: plan.every]
    progress("render the plane", 0.0)
    zones = _zones(start)
    lit = zone_captures(captures, start.sensor, zones)
    progress("calibrate", 0.05)
    fitted = calibrate([lit[at] for at in used], start.sensor, zones, free=FITTED, model_error=MODEL_ERROR)
    expected = expected_of(lit, fitted)
    errors = compare(captures.counts, expected, fitted.sensor.bin_width_s, seed)
    return Prediction(plan, start, captures, lit, used, fitted, expected, errors)


def _zones(start: SensorFile) -> ZoneArray:
    assert start.zones is not None  # SENSOR is a chip of zones
    return start.zones


def write_calibrated(of: Prediction, out: Path) -> Path:
    """Write the calibrated sensor's file."""
    nearest = of.captures.distance_m[of.used[0]]
    how = f"calibrated from {len(of.used)} captures of {shipped_captures().name}, {nearest:g} m on"
    name = f"{SENSOR}-calibrated"
    return write_sensor(calibrated_file(of.start, of.fitted, name, how), out / f"{name}.toml")


def span_rows(of: Prediction) -> list[JsonObject]:
    """Return errors of the captures held out, a row a span of distances that has any."""
    rows = []
    for low, high in SPANS:
        inside = of.held & (of.captures.distance_m >= low) & (of.captures.distance_m < high)
        if inside.any():
            rows.append({"from_m": low, "to_m": high, **summary(of.errors, inside)})
    return rows


def expected_of(captures: Sequence[ZoneCapture], fitted: Calibration) -> np.ndarray:
    """Return expected counts (N, Z, T) of captures on the calibrated sensor."""
    return np.array([expected_zone_counts(c.returns, fitted.sensor, fitted.zones, c.drift_s) for c in captures])


def digest_of(of: Prediction) -> str:
    """Return what results are kept by: captures, plan, the sensor begun with and the calibrated one."""
    sha = hashlib.sha256(repr((FORMAT, asdict(of.plan), FITTED, of.start.sensor, of.start.zones)).encode())
    for values in (of.captures.distance_m, of.captures.counts, of.expected, *of.fitted.values.values()):
        sha.update(np.ascontiguousarray(values).tobytes())
    return sha.hexdigest()


def ablated(of: Prediction, store: Store, digest: str, progress: Progress) -> list[JsonObject]:
    """Return a row for the whole model, then one for each effect that is off, or of TRIED on, while the rest is
    calibrated again. What the store has is not computed again.

    All by cross-validation within the captures calibrated on: those held out have no say in what the model holds.
    """
    zones = _zones(of.start)
    rows: list[JsonObject] = []
    for number, effect in enumerate(("none", *of.plan.ablated)):
        off, lit = zones if effect in ("none", *TRIED) else zones.without(effect), of.lit
        parameter = {"saturation": "trials"}.get(effect, effect)
        name, free = f"without {effect}", tuple(one for one in FITTED if one not in _gone_with(parameter))
        if effect == "none":
            name = effect
        elif effect in TRIED:
            name, free = f"with {effect}", (*FITTED, effect)
        elif effect in GEOMETRY and off != zones:
            lit = zone_captures(of.captures, of.start.sensor, off)
        elif parameter not in FITTED:
            continue  # off in the preset
        kept = store.get(digest, off=effect)
        if kept is None:
            progress(name, 0.3 + 0.5 * number / (1 + len(of.plan.ablated)))
            kept = {"effect": name, **cross_validated(of, lit, off, free)}
            store.put(digest, kept, off=effect)
        rows.append(kept)
    return rows


def cross_validated(
    of: Prediction, lit: Sequence[ZoneCapture], zones: ZoneArray, free: tuple[str, ...]
) -> dict[str, list[float] | float]:
    """Summarise the errors of the captures calibrated on, each predicted by the folds that it is not in."""
    expected, width = np.zeros(of.captures.counts[of.used].shape), 0.0
    for fold in range(of.plan.folds):
        out = np.arange(len(of.used)) % of.plan.folds == fold
        seen = [lit[at] for at in of.used[~out]]
        fitted = calibrate(seen, of.start.sensor, zones, free=free, model_error=MODEL_ERROR, start=of.fitted)
        expected[out] = expected_of([lit[at] for at in of.used[out]], fitted)
        width += fitted.sensor.bin_width_s / of.plan.folds
    return summary(compare(of.captures.counts[of.used], expected, width), np.arange(len(expected)))


def _gone_with(parameter: str) -> tuple[str, ...]:
    """Return the parameters that are off together with `parameter`: nothing recovers where nothing saturates."""
    return ("trials", "recovery") if parameter == "trials" else (parameter,)


def chip_range(captures: PlaneCaptures) -> dict[str, list[float]]:
    """Return the chip's own answer less the arm's distance, by zone [mm]."""
    error = 1e3 * (captures.chip_m - captures.distance_m[:, None])
    return {"bias_mm": np.nanmean(error, axis=0).tolist(), "spread_mm": np.nanstd(error, axis=0).tolist()}


def pose_rows(of: Prediction, store: Store, digest: str, model_error: float) -> list[dict[str, float]]:
    """Return errors of distance and tilt of single captures held out, their standard errors, and half widths of 95 %
    intervals.

    The arm's plane faces the sensor. What the model's errors add to the Fisher covariance is measured on poses of the
    captures calibrated on.
    """

    def found(at: int) -> tuple[Pose, np.ndarray]:
        kept = store.get(digest, pose=int(at), model_error=model_error)
        pose = search(at) if kept is None else Pose(*map(np.array, kept))
        if kept is None:
            store.put(digest, [part.tolist() for part in pose], pose=int(at), model_error=model_error)
        return pose, pose.values - np.array([of.captures.distance_m[at], 0.0, 0.0, 1.0])

    def search(at: int) -> Pose:
        counts = of.captures.counts[at].astype(np.float64)
        drift_s = float(of.captures.drift_bins[at]) * of.fitted.sensor.bin_width_s
        start_m = nearest_start(counts, of.captures.distance_m[of.used], of.expected[of.used])
        sensor, zones = of.fitted.sensor, of.fitted.zones
        return find_pose(counts, sensor, zones, start_m, drift_s=drift_s, model_error=model_error)

    known = [found(at) for at in of.used[:: of.plan.pose_every]]
    model = model_covariance(np.array([error for _, error in known]), np.array([pose.covariance for pose, _ in known]))
    rows = []
    for at in of.judged[:: of.plan.pose_every]:
        pose, error = found(at)
        sigma, half = model.interval(pose)
        row: dict[str, float] = {"distance_m": float(of.captures.distance_m[at])}
        for number, (name, unit) in enumerate(UNITS.items()):
            row[f"{name}_error"] = float(error[number]) * unit
            row[f"{name}_photon_sigma"] = float(pose.covariance[number, number]) ** 0.5 * unit
            row[f"{name}_sigma"] = float(sigma[number]) * unit
            row[f"{name}_interval"] = float(half[number]) * unit
        rows.append(row)
    return rows


def pose_summary(rows: Sequence[dict[str, float]]) -> JsonObject:
    """Return of each quantity the median error, its mean, and the share of 95 % intervals that hold the arm's pose."""
    found: JsonObject = {"captures": len(rows)}
    for name in ("distance_mm", "about_y_deg", "about_x_deg"):
        columns = ("error", "photon_sigma", "sigma", "interval")
        error, photons, sigma, half = (np.array([row[f"{name}_{what}"] for row in rows]) for what in columns)
        found[name] = {
            "median_error": float(np.median(np.abs(error))),
            "worst_error": float(np.abs(error).max()),
            "bias": float(error.mean()),
            "spread": float(error.std()),
            "median_photon_sigma": float(np.median(photons)),
            "median_sigma": float(np.median(sigma)),
            "covered": float((np.abs(error) < half).mean()),
            "covered_interval": binomial_interval(int((np.abs(error) < half).sum()), len(rows)),
            "covered_by_photons_alone": float((np.abs(error) < 1.96 * photons).mean()),
        }
    return found


def binomial_interval(held: int, number: int) -> list[float]:
    """Return the exact 95 % interval of a share, `held` of `number` (Clopper and Pearson, 1934)."""
    found = binomtest(held, number).proportion_ci(0.95, "exact")
    return [float(found.low), float(found.high)]


def draw_all(of: Prediction, poses: Sequence[dict[str, float]], out: Path) -> list[Path]:
    """Draw histograms of the zones at three distances, errors against distance, and poses."""
    _, columns, order = zone_grid(of.fitted.zones)
    distance_m, left_out = of.captures.distance_m, np.flatnonzero(of.held)
    shown = [left_out[np.abs(distance_m[left_out] - metres).argmin()] for metres in of.plan.shown_m]
    counts, expected = of.captures.counts[shown], of.expected[shown]
    return [
        figures.draw_histograms(
            distance_m[shown], counts, expected, order, columns, out / "sim-to-real-histograms.png"
        ),
        figures.draw_errors(distance_m, of.held, of.errors, out / "sim-to-real-errors.png"),
        figures.draw_poses(poses, out / "sim-to-real-pose.png"),
        draw_pile_up(out / "sim-to-real-pile-up.png"),
    ]


def _flat(rows: Sequence[JsonObject]) -> list[JsonObject]:
    """Rows for a table: of a list over zones its median and its worst."""
    found = []
    for row in rows:
        line: JsonObject = {}
        for key, value in row.items():
            if isinstance(value, list):
                line |= {f"{key} median zone": float(np.median(value)), f"{key} worst zone": max(value, key=abs)}
            else:
                line[key] = value
        found.append(line)
    return found


def in_words(numbers: JsonObject) -> dict[str, list[str]]:
    """Return what the terminal shows."""
    spans = [
        f"{s['from_m']:g} to {s['to_m']:g} m, {s['captures']} captures: shape nRMSE "
        f"{max(s['shape_median']):.3f} in the worst zone, amplitude within {max(s['amplitude_worst']):.1%}, range bias "
        f"{max(map(abs, s['range_bias_mm'])):.2f} mm, {s['covered']:.0%} of bins in their interval"
        for s in numbers["prediction"]
        if s["from_m"] >= 0.05
    ]
    without = [
        f"{row['effect']}: deviance {row['deviance']:.1f} a bin, shape {max(row['shape_median']):.3f}, amplitude "
        f"{max(row['amplitude_worst']):.1%}, range bias {max(map(abs, row['range_bias_mm'])):.2f} mm"
        for row in numbers["ablation"]
    ]
    pose = [
        f"{name}: median error {of['median_error']:.2f}, {of['covered']:.0%} of 95 % intervals hold the arm's "
        f"({of['covered_by_photons_alone']:.0%} of those by photons alone)"
        for name, of in ((name, numbers["pose"][name]) for name in ("distance_mm", "about_y_deg", "about_x_deg"))
    ]
    laws = [f"{of['from']} to {HIGH}, {of['law']} {of['number']:g}: {of['nrmse']:.3f}" for of in numbers["pile_up"]]
    return {"prediction": spans, "ablation": without, "pose": pose, "nRMSE of pulses": laws}
