"""Transient -> Histogram: draw what the sensor detects, by the law that its flux and its detector ask for."""

from __future__ import annotations

from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from scenes.io.versions import installed_versions
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from scenes.progress import Progress
from spad.detection.detectors import LAWS
from spad.detection.exposure import Exposure, counts_of, timestamps_of
from spad.detection.glints import glint_warning, signal_fractions
from spad.detection.laws import LOW_FLUX
from spad.detection.photons import expected_signal, light_of
from spad.detection.rates import rates_for
from spad.measurements.histogram import Histogram
from spad.measurements.timestamps import Timestamps
from spad.sensor.arrival import record_line, wrap_line
from spad.sensor.model import PhotonBudget, Sensor

Model = Literal["auto", "poisson", "first-photon", "free-running"]
MODELS: tuple[str, ...] = ("auto", *LAWS)
_HASHES: WeakKeyDictionary[Transient, str] = WeakKeyDictionary()
BYTES_PER_STAMP = 4  # two each, in parts and joined
IDLE = "the dead time of {:g} s has no effect, as the detector is armed at every cycle"


def sense(
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    *,
    seed: int = 0,
    model: Model = "auto",
    dark_map_hz: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Histogram:
    """Record one exposure as a histogram.

    poisson        n_i ~ Poisson(lambda_i) in every pixel and bin, independently: exact at low flux
    first-photon   a synchronous detector counts the first photon of each cycle: one multinomial over all cycles
    free-running   event by event, blind for the sensor's dead time after each detection
    auto           poisson up to 1 % primary detections per cycle (or dead time, if longer) in the brightest pixel;
                   above it first-photon where the detector is armed at every cycle, else free-running

    Crosstalk is added where the sensor has it. `dark_map_hz` (H, W) takes the place of the sensor's dark count rate,
    NaN in dead pixels. Every 1024 pixels have a stream of their own, SeedSequence(seed, spawn_key=(stage, 0, block)).
    `meta` holds the plan, `pile_up`: the expected primary detections per cycle of the brightest pixel, before dead time
    and pile-up take theirs (what is counted after them is in `counts`), within the bins where the detector is armed at
    every cycle, else over the whole period; the share of signal detections that wrapped
    around the period, the share of the background that is dark counts, the shares of the signal in the brightest pixel
    and in the brightest thousandth of pixels, and the median pixel's signal (`spad.detection.glints`). Raises
    InputError for an unknown law, first-photon where the dead time is longer than the period, and more than 2^31 - 1
    counts in a bin.

    Examples
    --------
    >>> import spad
    >>> from render import RenderSettings, render
    >>> from scenes.library.catalog import load_scene
    >>> transient = render(load_scene("plane", width=8, height=6), RenderSettings(bounces=1))
    >>> spad.sense(transient, spad.Sensor(), spad.PhotonBudget(signal=20, background=5)).counts.shape
    (6, 8, 1024)
    """
    exposure, truth = _planned(transient, sensor, budget, seed, model, dark_map_hz)
    return Histogram(counts=counts_of(exposure, progress), sensor=sensor, budget=budget, **truth)


def sense_timestamps(
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    *,
    seed: int = 0,
    model: Model = "auto",
    dark_map_hz: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Timestamps:
    """Return the same exposure as `sense`, detection for detection, as timestamps: no histogram where photons are
    few.

    Raises InputError where so many detections are expected that their timestamps would not fit into memory.
    """
    exposure, truth = _planned(transient, sensor, budget, seed, model, dark_map_hz)
    expected = sum(float(truth[name].sum(dtype=np.float64)) for name in ("expected_signal", "expected_background"))
    require_memory(BYTES_PER_STAMP * expected, f"{expected:.3g} timestamps")
    return timestamps_of(exposure, truth["meta"], progress)


def expected_in_pixel(
    transient: Transient, sensor: Sensor, budget: PhotonBudget, row: int, column: int, *, seed: int = 0
) -> np.ndarray:
    """Return expected primary detections per bin of one pixel, (T,) float64: the rates that `sense` draws from."""
    from spad.detection.flux import expected_counts  # with torch, whose import takes a second

    pixel = row * transient.width + column
    rates = rates_for(transient, sensor, budget, seed=seed)
    rate, _ = expected_counts(transient, sensor, rates, slice(pixel, pixel + 1))
    return rate[0].numpy()


# The plan


def _planned(
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    seed: int,
    model: str,
    dark_map_hz: np.ndarray | None,
) -> tuple[Exposure, JsonObject]:
    """Prepare the exposure, and what its histogram holds beside the counts."""
    if model not in MODELS:
        raise InputError(f"detection model {model!r} is unknown, expected one of {', '.join(MODELS)}")
    rates = rates_for(transient, sensor, budget, dark_map_hz=dark_map_hz, seed=seed)
    light = light_of(transient, sensor, rates, slice(0, transient.height * transient.width))
    signal, wrapped = expected_signal(light, sensor)
    signal = signal.reshape(transient.height, transient.width)
    # background falls on the whole period, also where it has no bins
    background = rates.background * (sensor.bins / sensor.bins_per_period)
    all_light = light.signal_per_pixel()
    pile_up = _pile_up(model, sensor, signal + background, all_light + rates.background.ravel())
    chosen, reason = choose_model(model, pile_up, sensor)
    reasons = [*rates.reasons, reason]
    if sensor.bins == 1:
        reasons.append("warning: one bin: photons are counted, but not timed, so that there is no depth")
    if sensor.crosstalk:
        reasons.append(f"crosstalk: a detection fires each of its neighbours with probability {sensor.crosstalk:.3%}")
    # where pixels are dead, less than the budget is detected: all light but theirs, which `wrapped` leaves out, too
    detected = float(all_light.sum()) if (rates.alive == 0).any() else budget.signal * signal.size
    fraction = wrapped / detected if wrapped > 0 else 0.0
    if wrapped > 0:
        reasons.append(wrap_line(fraction, sensor))
    fractions = signal_fractions(signal)
    missed = 1 - float(signal.sum()) / detected if detected > 0 else 0.0
    # the photon budget is of all light, whether there are bins for it or not, and so is the part that a glint takes
    lines = (record_line(missed, sensor), glint_warning(signal_fractions(all_light)))
    reasons += [line for line in lines if line is not None]
    meta = {
        "seed": int(seed),
        "model": chosen,
        "plan": reasons,
        "pile_up": pile_up,
        "wrapped": fraction,
        "dark_share": rates.dark_fraction,
        "brightest_pixel": fractions.brightest_pixel,
        "brightest_thousandth": fractions.brightest_thousandth,
        "median_signal": fractions.median,
        "transient": {**transient.meta, "sha256": _sha256(transient)},
        "versions": installed_versions("scene2spad", "numpy", "torch"),
    }
    truth = {
        "depth_m": transient.depth_m,
        "mixed": transient.mixed,
        "albedo": transient.albedo,
        "expected_signal": signal.astype(np.float32),
        "expected_background": background.astype(np.float32),
        "meta": meta,
    }
    return Exposure(transient, sensor, rates, light, LAWS[chosen], seed), truth


def _pile_up(model: str, sensor: Sensor, recorded: np.ndarray, over_period: np.ndarray) -> float:
    """Return the primary detections per cycle of the brightest pixel: those within the record where the detector is
    armed at every cycle, else of the whole period, as those outside the record blind it, too."""
    armed_by_dead_time = model == "free-running" or (model != "first-photon" and not sensor.armed_every_cycle)
    return float((over_period if armed_by_dead_time else recorded).max(initial=0) / sensor.cycles)


def _sha256(transient: Transient) -> str:
    """Return the SHA-256 of a transient, computed once: one render is sensed many times, and transients are
    immutable."""
    if transient not in _HASHES:
        _HASHES[transient] = transient.sha256()
    return _HASHES[transient]


def mean_pixel_law(sensor: Sensor, budget: PhotonBudget) -> tuple[str, float]:
    """Return the law that `auto` would choose were every pixel as bright as the mean one, and that pixel's primary
    detections per cycle."""
    recorded = budget.signal + budget.background * (sensor.bins / sensor.bins_per_period)
    pile_up = _pile_up("auto", sensor, np.array([recorded]), np.array([budget.signal + budget.background]))
    return choose_model("auto", pile_up, sensor)[0], pile_up


def choose_model(asked: str, pile_up: float, sensor: Sensor) -> tuple[str, str]:
    """Choose the detection law for `pile_up` primary detections per cycle in the brightest pixel, and say why.

    A dead time that has no effect, as the detector is armed at every cycle all the same, is told. Raises InputError for
    the first-photon law where the dead time outlasts the period.
    """
    outlasts = sensor.dead_time_s > sensor.period_s
    if asked == "first-photon" and outlasts:
        raise InputError(
            f"model first-photon: the dead time of {sensor.dead_time_s:g} s is longer than the period of "
            f"{sensor.period_s:g} s, the detector is not armed at every cycle; use free-running"
        )
    message = f"{pile_up:.2%} primary detections a cycle in the brightest pixel ({sensor.cycles:,.0f} cycles)"
    blind = pile_up * max(1.0, sensor.dead_time_s / sensor.period_s)
    if outlasts:
        message += f", {blind:.2%} a dead time"
    no_effect = sensor.armed_every_cycle and sensor.dead_time_s > 0
    idle = f"; {IDLE.format(sensor.dead_time_s)}" if no_effect else ""
    if asked != "auto":
        left_out = ": pile-up and dead time, which matter from 1 %, are left out"
        return (
            asked,
            f"model: {asked} as asked, at {message}{left_out if asked == 'poisson' and blind > LOW_FLUX else ''}"
            f"{idle if asked == 'first-photon' else ''}",
        )
    if blind <= LOW_FLUX:
        return "poisson", f"model: independent Poisson, {message}{idle}"
    if sensor.armed_every_cycle:
        return (
            "first-photon",
            f"model: first photon of each cycle (pile-up), {message}{idle or ', armed at every cycle'}",
        )
    if sensor.dead_time_s == 0:
        return (
            "poisson",
            f"model: independent Poisson, {message}, but a free-running detector without dead time loses none",
        )
    why = "which outlasts the period" if outlasts else "free-running"
    return "free-running", f"model: event by event (pile-up), {message}, dead time {sensor.dead_time_s:g} s, {why}"
