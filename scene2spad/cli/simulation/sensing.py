"""The command `sense`: the sensor and the budget that its options ask for, the draw, and the files."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from render.transient import Transient, read_transient
from scene2spad.cli.paths import Mark, begins, check_target, holds_kind, input_file, keep_foreign, output_file, picture
from scene2spad.options.common import only_for
from scene2spad.options.simulation import Sense
from scenes.errors import InputError, require
from scenes.files import read_array
from scenes.io.hdf5 import HDF5_SUFFIXES
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.detection.one_pixel import quadrature_in_pixel
from spad.detection.rates import default_background
from spad.estimators.bistatic import baseline_of
from spad.measurements.histogram import Histogram, write_histogram
from spad.sensor.budget import Optics
from spad.sensor.files import FWHM_PER_SIGMA, load_sensor
from spad.sensor.model import HOT_RATE_HZ, PhotonBudget, Sensor, check_dark_map
from spad.sensor.pulse import AnyPulse, Pulse, read_pulse
from spad.sensor.zone_array import ZoneArray

log = logging.getLogger("scene2spad")

DEFAULT_PHOTONS = 50.0
OPTICS = {  # options, and the fields that they set
    "pulse_energy": "pulse_energy_j",
    "focal_length": "focal_length_m",
    "f_number": "f_number",
    "pixel_pitch": "pixel_pitch_m",
    "transmission": "transmission",
    "filter_width": "filter_nm",
    "wavelength": "wavelength_m",
}
PIXELS_OF_A_MAP = ("dark_count_rate", "hot_pixels", "hot_rate", "dead_pixels")  # which a map of dark counts measures
PIXELS_ALONE = (  # gains and backgrounds of zones are detections an exposure, whatever efficiency and exposure are
    *("radiometric", "dark_map", "export", "dark_count_rate", "dead_time", "crosstalk", "hot_pixels", "hot_rate"),
    *("dead_pixels", "reset", "pde", "exposure"),
)
DEFAULT_OPTICS = Optics(10e-9, 10e-3, 2.0, 20e-6, 0.8, 10.0, 850e-9)


def sensor_of(command: Sense) -> Sensor:
    """Return the preset, or the sensor of a file, with what the options change."""
    return changed_sensor(load_sensor(command.sensor).sensor, command)


def changed_sensor(sensor: Sensor, command: Sense) -> Sensor:
    """Return the sensor with the fields that the options set."""
    asked = {
        "bins": command.bins,
        "bin_width_s": command.bin_width,
        "period_s": command.period,
        "dark_count_rate_hz": command.dark_count_rate,
        "reset": command.reset,
        "dead_time_s": command.dead_time,
        "exposure_s": command.exposure,
        "pde": command.pde,
        "crosstalk": command.crosstalk,
        "hot_share": command.hot_pixels,
        "hot_rate_hz": command.hot_rate,
        "dead_share": command.dead_pixels,
    }
    changes: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if ("bins" in changes or "bin_width_s" in changes) and command.period is None:
        changes["period_s"] = None
    if command.hot_pixels and command.hot_rate is None and not sensor.hot_rate_hz:
        changes["hot_rate_hz"] = HOT_RATE_HZ
    hot = sensor.hot_share if command.hot_pixels is None else command.hot_pixels
    only_for(command, "sense", {"hot_rate": (hot != 0, "hot pixels (--hot-pixels)")})
    if command.jitter is not None:
        try:
            changes["jitter"] = Pulse(command.jitter, command.jitter_tail)
        except InputError as error:  # speaks of a pulse
            raise InputError(f"--jitter: {error}") from None
    require(command.jitter is not None or not command.jitter_tail, "--jitter-tail needs --jitter")
    pulse = _asked_pulse(command)
    if pulse is not None:
        changes["pulse"] = pulse
    try:
        return replace(sensor, **changes)
    except InputError as error:  # speaks of fields
        words = str(error).replace("hot_share", "--hot-pixels").replace("dead_share", "--dead-pixels")
        raise InputError(words) from None


def _asked_pulse(command: Sense) -> AnyPulse | None:
    """Return the pulse that the options ask for, None where they leave the preset's."""
    require((command.pulse is None) == (command.pulse_step is None), "--pulse and --pulse-step go together")
    require(command.pulse is None or command.pulse_fwhm is None, "give --pulse or --pulse-fwhm, not both")
    require(command.pulse_fwhm is not None or not command.pulse_tail, "--pulse-tail needs --pulse-fwhm")
    if command.pulse is not None and command.pulse_step is not None:
        return read_pulse(command.pulse, command.pulse_step)
    if command.pulse_fwhm is None:
        return None
    try:
        return Pulse(command.pulse_fwhm / FWHM_PER_SIGMA, command.pulse_tail)
    except InputError as error:  # speaks of sigma
        raise InputError(f"--pulse-fwhm {command.pulse_fwhm:g}, --pulse-tail {command.pulse_tail:g}: {error}") from None


def optics_of(command: Sense) -> Optics | None:
    """Return the optics of a radiometric budget, None without one: the sensor file's with what the options change."""
    only_for(command, "sense", dict.fromkeys(OPTICS, (command.radiometric, "a --radiometric budget")))
    if not command.radiometric:
        return None
    given = command.signal is not None or command.background is not None
    require(not given, "--radiometric computes the photon budget: leave out --signal and --background")
    asked = {field: getattr(command, option) for option, field in OPTICS.items()}
    optics = load_sensor(command.sensor).optics or DEFAULT_OPTICS
    try:
        return replace(optics, **{name: value for name, value in asked.items() if value is not None})
    except InputError as error:  # speaks of fields
        words = str(error)
        for option, field in OPTICS.items():
            words = words.replace(f"optics: {field} ", f"--{option.replace('_', '-')} ")
        raise InputError(words) from None


def budget_of(command: Sense) -> PhotonBudget:
    """Return the budget by means that the options ask for."""
    asked = (DEFAULT_PHOTONS if value is None else value for value in (command.signal, command.background))
    return PhotonBudget(*asked)


def run(command: Sense, progress: Progress) -> dict:
    """Run the command: transient -> histogram, its picture, and the .mat layout where asked."""
    zones = load_sensor(command.sensor).zones
    if zones is not None:
        return _run_zones(command, zones, progress)
    sensor, optics = sensor_of(command), optics_of(command)
    budget = budget_of(command)
    _refuse(command, PIXELS_OF_A_MAP if command.dark_map is not None else (), "--dark-map")
    source, out = _files(command)
    transient = read_transient(source)
    if command.pde is not None and optics is None:
        log.warning("--pde %g changes nothing: the photons of a budget are detected ones", command.pde)
    mat = out.with_suffix(".mat")
    if command.export == "mat":
        _check_mat(mat, transient, sensor)
    dark_map = None if command.dark_map is None else read_dark_map(command.dark_map, transient)
    if optics is not None:
        budget = optics.budget(transient, sensor, seed=command.seed, dark_map_hz=dark_map)
    elif command.background is None:
        background = default_background(transient, sensor, dark_map_hz=dark_map, seed=command.seed)
        budget = replace(budget, background=background)
    start = time.perf_counter()
    histogram = sense(
        transient, sensor, budget, seed=command.seed, model=command.model, dark_map_hz=dark_map, progress=progress
    )
    seconds = time.perf_counter() - start
    _log_plan(histogram)
    write_histogram(histogram, out)
    result = {"seconds": seconds, **summary(histogram), "out": str(out)}
    if command.export == "mat":
        from spad.formats.mat import pile_up_warning, write_mat

        warning = pile_up_warning(histogram)
        if warning is not None:
            log.warning("%s: %s", mat, warning)
        result.update({"pulse_file": str(write_mat(histogram, mat)), "export": str(mat)})
    if command.figure:
        from scene2spad.plots.pixels import draw_histogram

        # a map of dark counts is not part of the rates that the figure could draw
        rate = partial(quadrature_in_pixel, transient, sensor, budget, seed=command.seed) if dark_map is None else None
        result["figure"] = str(draw_histogram(histogram, picture(out, "histogram"), expected=rate))
    return result


def _files(command: Sense) -> tuple[Path, Path]:
    """Return the transient's file and the histogram's, checked."""
    source = input_file(command.file)
    histogram_given = source.suffix.lower() in HDF5_SUFFIXES
    require(not histogram_given, f"{source}: is an HDF5 file, expected a transient (.exr) that `render` wrote")
    if not holds_kind(source, "transient"):
        read_transient(source)  # says what is wrong with it before anything is said of the output
    out = command.out or source.with_suffix(".h5")
    return source, output_file(out, ".h5", "histogram", figure=command.figure)


def _check_mat(path: Path, transient: Transient, sensor: Sensor) -> None:
    """Raise InputError where the .mat file, or its pulse's, is another program's or cannot be written, and for what
    the layout cannot hold."""
    from spad.formats.mat import PULSE_NAME, check_mat

    check_target(path)
    keep_foreign(path, Mark(".mat file", is_our_mat))
    for pulse in path.parent.glob(f"{PULSE_NAME}{transient.height}_*-{transient.width}.mat"):
        keep_foreign(pulse, Mark("pulse", is_our_mat))
    check_mat(path, sensor, transient.height, transient.width, baseline_of(transient.meta))


def is_our_mat(path: Path) -> bool:
    """Tell whether `sense` wrote a .mat file, or its pulse: by the header, or as older versions left it to scipy.

    The published files come from MATLAB, whose header names another platform.
    """
    from spad.formats.matfile import HEADER_TEXT, load_mat

    if begins(path, re.escape(HEADER_TEXT)):
        return True
    if not begins(path, rb"MATLAB 5.0 MAT-file Platform: posix"):
        return False
    try:
        held = load_mat(path, ["dist", "bin_hr", "psf", "pulse_len"]).keys()
    except InputError:
        return False
    return {"dist", "bin_hr"} <= held or {"psf", "pulse_len"} <= held


def _refuse(command: Sense, options: Sequence[str], beside: str) -> None:
    """Raise InputError for options, by their fields' names, that were given beside what leaves them without effect."""
    for option in options:
        given = getattr(command, option) not in (None, False)
        require(not given, f"--{option.replace('_', '-')} does not go with {beside}")


def _run_zones(command: Sense, zones: ZoneArray, progress: Progress) -> dict:
    """Transient -> histogram of a multi-zone sensor, whose gains are its own unless a budget is asked for."""
    from spad.zones.histogram import sense_zones, with_budget

    _refuse(command, PIXELS_ALONE, "a sensor of zones")
    require(command.model == "auto", f"--model {command.model} does not go with a sensor of zones")
    optics_of(command)
    sensor = sensor_of(command)
    source, out = _files(command)
    transient = read_transient(source)
    start = time.perf_counter()
    asked = command.signal is not None or command.background is not None
    calibrated = set(zones.gain) != {1.0}
    if asked or not calibrated:
        for name, other in (("signal", "background"), ("background", "signal")):
            if calibrated and getattr(command, name) is None:
                message = "%s: %g photons a zone, the default, and not as calibrated, since --%s is given"
                log.warning(message, name, DEFAULT_PHOTONS, other)
        zones = with_budget(zones, transient, sensor, budget_of(command), progress=progress)
    else:
        log.info("signal and background: as calibrated; --signal and --background set them")
    histogram = sense_zones(transient, sensor, zones, seed=command.seed, progress=progress)
    seconds = time.perf_counter() - start
    _log_plan(histogram)
    write_histogram(histogram, out)
    result = {"seconds": seconds, **summary(histogram), "out": str(out)}
    if command.figure:
        from scene2spad.plots.pixels import draw_histogram

        result["figure"] = str(draw_histogram(histogram, picture(out, "histogram"), expected=None))
    return result


def _log_plan(histogram: Histogram) -> None:
    for reason in histogram.meta["plan"]:
        log.log(logging.WARNING if reason.startswith("warning:") else logging.INFO, "%s", reason)


def summary(histogram: Histogram) -> dict:
    """Summarise a histogram for the command's result.

    `pile_up` is of primary detections, before dead time; `detections_per_cycle` what the brightest pixel counted.
    """
    meta = histogram.meta
    fullest = histogram.counts.sum(axis=2, dtype=np.int64).max(initial=0)
    return {
        "mean_signal": float(histogram.expected_signal.mean(dtype=np.float64)),
        "mean_background": float(histogram.expected_background.mean(dtype=np.float64)),
        "mean_counts": float(histogram.counts.sum(dtype=np.int64) / histogram.depth_m.size),
        "detections_per_cycle": float(fullest / histogram.sensor.cycles),
        **{name: meta[name] for name in ("pile_up", "model", "wrapped", "dark_share")},
        **{name: meta[name] for name in ("brightest_pixel", "brightest_thousandth", "median_signal")},
    }


def read_dark_map(path: Path, transient: Transient) -> np.ndarray:
    """Read dark counts per second of every pixel (.npy), NaN for a dead one. Raises InputError that names the file."""
    rates = read_array(path)
    try:
        check_dark_map(rates, (transient.height, transient.width))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return rates
