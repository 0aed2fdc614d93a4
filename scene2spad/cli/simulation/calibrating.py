"""The command `calibrate`: captures before a plane -> the sensor file that predicts them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from scene2spad.cli.paths import Mark, check_target, keep_foreign
from scene2spad.datasets.zone_captures import (
    PlaneCaptures,
    read_plane_captures,
    require_same_zones,
    shipped_captures,
    within,
    zone_captures,
)
from scene2spad.options.simulation import Calibrate
from scenes.errors import InputError, require
from scenes.progress import Progress
from spad.sensor.files import load_sensor, read_sensor, write_sensor
from spad.sensor.model import Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.calibration import (
    MIN_FITTED,
    Calibration,
    calibrate,
    calibrated_file,
    check_effects,
    check_returns,
    poisson_deviance,
    sees_return,
)
from spad.zones.evidence import WRONG, check_distances, check_fit
from spad.zones.expected_counts import ZoneCapture
from spad.zones.simulation import expected_zone_counts

log = logging.getLogger("scene2spad")

MIN_CAPTURES = 16
# Parameters that are 0 or more; of others, as of delays, a value near 0 may be known well.
AMOUNTS = ("gain", "skew_s", "background", "leak", "echo_m2", "trials", "recovery", "compression", "crosstalk")
HOW = "calibrated from"  # first words of the sources that a written file names


def run(command: Calibrate, progress: Progress) -> dict:
    """Render the plane at each distance, fit every N-th capture, score the others, write the file."""
    _check_options(command)
    start = load_sensor(command.sensor)
    if start.zones is None:
        raise InputError(f"sensor {start.sensor.name} has no zones: its file needs a table [zones]")
    path = shipped_captures() if str(command.captures) == "shipped" else command.captures
    chosen = within(read_plane_captures(path), command.nearest)
    number = len(chosen.distance_m)
    enough = number >= MIN_CAPTURES
    require(enough, f"{path}: {number} captures from {command.nearest:g} m on, expected {MIN_CAPTURES} or more")
    _check_distances(chosen, start.sensor, path)
    require_same_zones(chosen, start.sensor, start.zones, f"{path}: ")
    _check_every(number, command.every, path)
    _check_zones(chosen, command.every, path)
    tried = chosen.chosen(np.arange(0, number, command.every))
    with _told_of(path):
        check_distances(tried.distance_m, tried.counts, start.sensor, start.zones, command.effects)
    began = time.perf_counter()
    progress("render the plane", 0.0)
    captures = zone_captures(chosen, start.sensor, start.zones)
    progress("fit", 0.3)
    used = captures[:: command.every]
    held = [one for at, one in enumerate(captures) if at % command.every]
    with _told_of(path):
        fitted = _fitted(used, start.sensor, start.zones, command)
        check_fit(fitted, tried.counts)
    warn_of_unknown(fitted)
    span = f"{chosen.distance_m[0]:g} to {chosen.distance_m[-1]:g} m"
    how = f"{HOW} {len(used)} captures of {path.name}, {span}"
    write_sensor(calibrated_file(start, fitted, command.out.stem, how), command.out)
    trials, recovery, compression = (values.tolist() for values in fitted.zones.saturation)
    return {
        "seconds": time.perf_counter() - began,
        "captures": len(used),
        "held_out": len(held),
        "deviance": fitted.deviance,
        "held_out_deviance": mean_deviance(held, fitted),
        "bin_width_ps": fitted.sensor.bin_width_s * 1e12,
        "trials": trials,
        "recovery": recovery,
        "compression": compression,
        "crosstalk": fitted.zones.crosstalk,
        "standard_errors": {name: float(np.max(error)) for name, error in fitted.errors.items()},
        "out": str(command.out),
    }


def _check_options(command: Calibrate) -> None:
    """Raise InputError for an option that needs no file to be wrong."""
    require(command.out.suffix == ".toml", f"{command.out}: the output must end in .toml")
    check_target(command.out)
    keep_foreign(command.out, Mark("calibrated sensor", is_calibrated))
    require(command.every >= 2, f"--every {command.every} leaves no capture to be held out, expected 2 or more")
    require(0 <= command.model_error < 1, f"--model-error {command.model_error:g} is outside 0 to 1")
    nearest = command.nearest
    require(math.isfinite(nearest) and nearest >= 0, f"--nearest {nearest:g}: expected a distance in m, 0 or more")
    check_effects(command.effects)


@contextmanager
def _told_of(path: Path) -> Iterator[None]:
    """Name the file in an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _fitted(captures: Sequence[ZoneCapture], sensor: Sensor, zones: ZoneArray, command: Calibrate) -> Calibration:
    """Fit the sensor; numbers that no sensor file holds are the captures' fault, and told as such."""
    try:
        return calibrate(captures, sensor, zones, free=command.effects, model_error=command.model_error)
    except InputError as error:
        raise InputError(f"the fit ends at no sensor ({error}): {WRONG}") from None


def is_calibrated(path: Path) -> bool:
    """Tell whether a file is a sensor file that `calibrate` wrote."""
    try:
        return any(source.startswith(HOW) for source in read_sensor(path).sources.values())
    except InputError:
        return False


def _check_distances(chosen: PlaneCaptures, sensor: Sensor, path: Path) -> None:
    """Raise InputError that names the file for a distance that the bins do not reach: mostly one in other units."""
    farthest, record_m = chosen.distance_m[-1], sensor.recorded_range_m
    message = f"{path}: distance_m {farthest:g} m is beyond the record of {record_m:.3g} m"
    require(farthest <= record_m, f"{message}: are these millimetres?")


def _check_every(number: int, every: int, path: Path) -> None:
    """Raise InputError that names the option where it leaves too few captures to fit."""
    used = -(-number // every)
    most = (number - 1) // (MIN_FITTED - 1)
    message = f"--every {every} fits {used} of {number} captures of {path}, {MIN_FITTED} are needed"
    require(used >= MIN_FITTED, f"{message}: expected --every {most} or less")


def warn_of_unknown(fitted: Calibration) -> None:
    """Warn of amounts whose standard error is larger than they are; what was found to be 0, or endless, is known."""
    vague = []
    for name in AMOUNTS:
        value = np.atleast_1d(getattr(fitted.zones, name))
        many = int((np.isfinite(value) & (value > 0) & (fitted.errors[name] > value)).sum())
        if many:
            vague.append(f"{name} of {many} zones" if len(value) > 1 else name)
    if vague:
        log.warning("standard error larger than the value, so that it is not known: %s", ", ".join(vague))


def _check_zones(chosen: PlaneCaptures, every: int, path: Path) -> None:
    """Raise InputError that names the file for a zone that the captures used say nothing of; warn of captures that some
    zone sees nothing in."""
    with _told_of(path):
        check_returns(chosen.counts[::every])
    blind = np.argwhere(~sees_return(chosen.counts))
    if len(blind):
        number, (first, zone) = len(np.unique(blind[:, 0])), blind[0]
        where = f"the first at {chosen.distance_m[first]:g} m, zone {zone}"
        message = "%s: in %d of %d captures a zone sees no return, %s; they are used as they are, see --nearest"
        log.warning(message, path, number, len(chosen.counts), where)


def mean_deviance(captures: Sequence[ZoneCapture], fitted: Calibration) -> float:
    """Return Poisson deviance a bin of captures: about 1 for a true model."""
    expected = [expected_zone_counts(c.returns, fitted.sensor, fitted.zones, c.drift_s) for c in captures]
    total = sum(poisson_deviance(c.counts, one) for c, one in zip(captures, expected, strict=True))
    return total / sum(c.counts.size for c in captures)
