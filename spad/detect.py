"""Transient -> Histogram: draw what the sensor detects."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from typing import Literal

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from spad.flux import expected_counts, rates_for
from spad.histogram import Histogram
from spad.sensor import PhotonBudget, Sensor

Model = Literal["auto", "poisson"]
STAGE_SENSE = 20
# Below 1 % detections per cycle dead time and pile-up change nothing that counts could show.
LOW_FLUX = 0.01
BLOCK_BINS = 1 << 22


def sense(
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    *,
    seed: int = 0,
    model: Model = "auto",
    progress: Callable[[str, float], None] | None = None,
) -> Histogram:
    """Record one exposure: n_i ~ Poisson(lambda_i) in every pixel and bin, independently (low flux).

    Every image row has a stream of its own, SeedSequence(seed, spawn_key=(stage, 0, row)), so that the counts do not
    depend on how the work is cut. `meta` holds the plan, the detections per cycle of the brightest pixel (`pile_up`)
    and the share of signal detections that wrapped around the period.
    """
    if model not in ("auto", "poisson"):
        raise InputError(f"detection model {model!r} is unknown, expected auto or poisson")
    rates = rates_for(transient, sensor, budget)
    height, width = transient.height, transient.width
    counts = np.empty((height, width, sensor.bins), dtype=np.int32)
    expected = np.empty((height, width))
    wrapped = 0.0
    rows_at_once = max(1, BLOCK_BINS // (width * sensor.bins_per_period))
    for top in range(0, height, rows_at_once):
        if progress is not None:
            progress("sense", top / height)
        bottom = min(top + rows_at_once, height)
        rate, late = expected_counts(transient, sensor, rates, slice(top * width, bottom * width))
        wrapped += late
        expected[top:bottom] = rate.sum(dim=1).numpy().reshape(-1, width)
        for row, row_rate in enumerate(rate.numpy().reshape(bottom - top, width, sensor.bins), start=top):
            counts[row] = _poisson(row_rate, np.random.SeedSequence(seed, spawn_key=(STAGE_SENSE, 0, row)))
    # background falls on the whole period, also where it has no bins
    background = rates.background * (sensor.bins / sensor.bins_per_period)
    pile_up = float(expected.max(initial=0) / sensor.cycles)
    reasons = [*rates.reasons, _why_poisson(pile_up, sensor)]
    if wrapped > 0:
        share = wrapped / (budget.signal * height * width)
        reasons.append(f"wrap: {share:.3%} of the signal arrives after the period of {sensor.range_m:.3f} m and wraps")
    return Histogram(
        counts=counts,
        sensor=sensor,
        budget=budget,
        depth_m=transient.depth_m,
        mixed=transient.mixed,
        albedo=transient.albedo,
        expected_signal=np.maximum(expected - background, 0).astype(np.float32),
        expected_background=background.astype(np.float32),
        meta={
            "seed": seed,
            "model": "poisson",
            "plan": reasons,
            "pile_up": pile_up,
            "wrapped": wrapped / (budget.signal * height * width) if wrapped > 0 else 0.0,
            "dark_share": rates.dark_share,
            "transient": {**transient.meta, "sha256": transient.sha256()},
            "versions": {name: importlib.metadata.version(name) for name in ("scene2spad", "numpy", "torch")},
        },
    )


def expected_in_pixel(transient: Transient, sensor: Sensor, budget: PhotonBudget, row: int, column: int) -> np.ndarray:
    """Expected detections per bin of one pixel, (T,) float64: the rates that `sense` draws from."""
    pixel = row * transient.width + column
    rate, _ = expected_counts(transient, sensor, rates_for(transient, sensor, budget), slice(pixel, pixel + 1))
    return rate[0].numpy()


def _poisson(rate: np.ndarray, seed: np.random.SeedSequence) -> np.ndarray:
    drawn = np.random.default_rng(seed).poisson(rate)
    most = drawn.max(initial=0)
    if most > np.iinfo(np.int32).max:
        raise InputError(f"a bin holds {most} counts, the limit is {np.iinfo(np.int32).max}")
    return drawn


def _why_poisson(pile_up: float, sensor: Sensor) -> str:
    said = f"{pile_up:.2%} detections a cycle in the brightest pixel ({sensor.cycles:,.0f} cycles)"
    if pile_up <= LOW_FLUX:
        return f"model: independent Poisson, {said}"
    return f"model: independent Poisson, although {said}: pile-up and dead time, which matter from 1 %, are left out"
