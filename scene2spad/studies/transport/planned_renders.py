"""Planned renders beside full ones in `study transport`: the error of depth on both, and what decides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from csph.evaluation.metrics import INTERVAL_LEVEL, image_errors
from render.transient import Transient
from scene2spad.networks.results import Store
from scene2spad.studies.transport.plan import FAILS, HOLDS, LEVELS, LIMIT, OPEN
from scene2spad.studies.transport.tables import Contender
from scenes.json_types import JsonObject
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor


@dataclass(frozen=True, eq=False)
class Place:
    """One scene under one laser: as all of it is rendered, and as the planner chose to."""

    name: str
    set: str
    laser: str
    full: Transient
    planned: Transient


class Expected(NamedTuple):
    """A transient with its expected counts (H, W, T) and background (H, W), photons."""

    transient: Transient
    counts: np.ndarray
    background: np.ndarray


def expected(transient: Transient, sensor: Sensor, budget: PhotonBudget) -> Expected:
    rates, pixels = rates_for(transient, sensor, budget), transient.height * transient.width
    counts = expected_counts(transient, sensor, rates, slice(0, pixels))[0].numpy()
    background = rates.background * (sensor.bins / sensor.bins_per_period)
    return Expected(transient, counts.reshape(transient.height, transient.width, sensor.bins), background)


def coupled(
    first: Expected, second: Expected, sensor: Sensor, budget: PhotonBudget, rng: np.random.Generator
) -> tuple[Histogram, Histogram]:
    """Return counts of two transients, each Poisson with its own rates a and b, that share the photons of min(a, b).

    Poisson(min) + Poisson(a - min) is Poisson(a): the difference of two errors is then free of most of what photons
    do to both.
    """
    least = np.minimum(first.counts, second.counts)
    shared = rng.poisson(least)
    made = []
    for transient, counts, background in (first, second):
        drawn = (shared + rng.poisson(np.maximum(counts - least, 0))).astype(np.int32)
        signal = np.clip(counts.sum(axis=2) - background, 0, None).astype(np.float32)
        truth = (transient.depth_m, transient.mixed, transient.albedo)
        made.append(Histogram(drawn, sensor, budget, *truth, signal, background.astype(np.float32)))
    return made[0], made[1]


def planned_rows(
    places: Sequence[Place],
    checked: Sequence[Contender],
    draws: Sequence[int],
    store: Store,
    seed: int,
    progress: Progress,
) -> list[JsonObject]:
    """Return a row of every scene, laser and design: MAE [mm] on both renders, their relative difference and its
    interval.

    `draws` of photons are made, by rising number, until every design of a scene is decided. Each number of draws is
    another look, so that its intervals decide at 1 - 5 % / looks (Bonferroni); those in the rows are of 95 %.
    """
    found: list[JsonObject] = []
    draws = sorted(set(draws))
    coverage = 1 - (1 - INTERVAL_LEVEL) / len(draws)
    for number, place in enumerate(places):
        progress(f"planned and full, {place.name}, {place.laser}", number / len(places))
        for count in draws:
            keys = [[(seed, number, draw, at) for draw in range(count)] for at in range(len(LEVELS))]
            # (levels, draws, designs, full and planned)
            errors = np.array([_both(place, checked, store, *one) for one in zip(LEVELS, keys, strict=True)])
            rows = [_row(place, one, errors[:, :, at], coverage) for at, one in enumerate(checked)]
            if all(row["verdict"] != OPEN for row in rows):
                break
        found += rows
    return found


def _row(place: Place, one: Contender, errors: np.ndarray, coverage: float) -> JsonObject:
    """Compare the (levels, draws, full and planned) errors [mm] of a design; an interval of `coverage` decides."""
    full, planned = errors[..., 0].mean(0), errors[..., 1].mean(0)
    fraction, wide = compared(full, planned)
    common = {"scene": place.name, "set": place.set, "laser": place.laser, "design": one.name, "draws": len(full)}
    numbers = {"full_mm": float(full.mean()), "planned_mm": float(planned.mean()), "difference": fraction}
    verdict = within(fraction, compared(full, planned, coverage)[1])
    return {**common, **numbers, "uncertain": wide, "verdict": verdict}


def _both(
    place: Place, checked: Sequence[Contender], store: Store, level: tuple[float, float], keys: Sequence[tuple]
) -> list[list[list[float]]]:
    """[full, planned] MAE [mm] of each draw of photons and design; what the store has is not drawn again."""
    pair = f"{place.full.sha256()[:32]}-{place.planned.sha256()[:32]}"
    sensor, budget, found = Sensor(), PhotonBudget(*level), []
    rates: tuple[Expected, Expected] | None = None
    for key in keys:
        named = {"pair": pair, "level": list(level), "draw": list(key)}
        missing = [one for one in checked if store.get(one.subject.digest, **named) is None]
        if missing:
            rates = rates or (expected(place.full, sensor, budget), expected(place.planned, sensor, budget))
            rng = np.random.default_rng(np.random.SeedSequence(key, spawn_key=(Stream.COUPLED,)))
            histograms = coupled(rates[0], rates[1], sensor, budget, rng)
            for one in missing:
                depths = [one.subject.model.depth_of(histogram)[0] for histogram in histograms]
                errors = [image_errors(depth, place.full.depth_m, sensor.range_m)["mae_mm"] for depth in depths]
                store.put(one.subject.digest, errors, **named)
        found.append([store.get(one.subject.digest, **named) for one in checked])
    return found


def compared(full: np.ndarray, planned: np.ndarray, coverage: float = INTERVAL_LEVEL) -> tuple[float, float]:
    """Return mean(planned) / mean(full) - 1 over draws of photons, and the half width of its interval by Student's
    t."""
    each = (planned - full) / full.mean()
    wide = float(stats.t.ppf(0.5 + coverage / 2, len(each) - 1) * stats.sem(each)) if len(each) > 1 else math.nan
    return float(each.mean()), wide


def within(fraction: float, wide: float) -> str:
    """Return whether a relative difference is under LIMIT, as far as its interval tells."""
    if abs(fraction) + wide < LIMIT:
        return HOLDS
    return FAILS if abs(fraction) - wide > LIMIT else OPEN


def planned_conclusions(planned: Sequence[JsonObject]) -> list[JsonObject]:
    """Return by scene and laser: the largest difference of a design; under LIMIT where that is so of every design."""
    found = []
    for scene, laser in dict.fromkeys((row["scene"], row["laser"]) for row in planned):
        mine = [row for row in planned if (row["scene"], row["laser"]) == (scene, laser)]
        verdicts = {row["verdict"] for row in mine}
        verdict = FAILS if FAILS in verdicts else OPEN if OPEN in verdicts else HOLDS
        largest = max(mine, key=lambda row: abs(row["difference"]))
        common = {"scene": scene, "laser": laser, "limit": LIMIT, "verdict": verdict}
        found.append({**common, **{name: largest[name] for name in ("design", "difference", "uncertain", "draws")}})
    return found
