"""Estimate the error of a whole image from a few of its pixels: finer direct light there, and their batches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from render.clamping import RemovedLight
from render.direct.integrator import centre_layers
from render.error import (
    UNKNOWN,
    CheckedPixels,
    ErrorEstimate,
    IndirectErrors,
    estimate,
    noise_of_responses,
    response,
    worst_fraction_of,
)
from render.indirect.integrator import image_cells
from render.indirect.path_cells import coarsened
from render.pipeline import LightSamples
from render.planning import CHECK_REFINEMENT, cone_width_px, finer_pilot
from render.probe import ProbePixels
from render.scene.traced_scene import TracedScene
from render.settings import Plan
from render.transient.samples import concatenate, no_samples, select_pixels

CLEAR = 3  # standard deviations above which a bias is believed


def estimated_error(world: TracedScene, plan: Plan, traced: LightSamples) -> ErrorEstimate:
    """Estimate the error of a trace, from the checked pixels' batches and from finer direct light there.

    It is UNKNOWN where these hold no light and others do, where finer cells, too, may miss the laser's cone, and where
    few paths looked for indirect light and all of the image is dark.
    """
    checked = traced.checked
    if CHECK_REFINEMENT * plan.grid * cone_width_px(world) < 1 or _may_have_missed_all(world, plan, traced):
        return UNKNOWN
    coarse = response(select_pixels(traced.direct, checked.pixel), checked.pixel)
    glints = response(select_pixels(traced.specular, checked.pixel), checked.pixel)
    fine = _finer(world, plan, checked) + glints
    coarse += glints
    if traced.indirect is None:
        return estimate(coarse, fine, weight=checked.weight) if fine.any() or not _is_lit(traced) else UNKNOWN
    seen = traced.indirect.probed
    place, origin_m = np.arange(len(checked.pixel)), traced.origin_m[checked.pixel]
    cells = image_cells(world, plan.indirect_tolerance_m, plan.indirect_growth, traced.origin_m, plan.bounces)
    # what merging changes, in two independent halves: their noise, which merging smooths, cancels in the product
    changes = []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        kept = seen.samples(half) if seen.radiance.shape[1] > 1 else no_samples()
        merged = coarsened(kept, cells, origin_m)
        changes.append(response(concatenate([merged, kept._replace(radiance=-kept.radiance)]), place))
    merging = (changes[0] * changes[1]).sum(axis=1)
    bias: np.ndarray | float = 0.0
    batches = [response(seen.samples(slice(b, b + 1)), place) for b in range(seen.radiance.shape[1])]
    indirect, noise = np.mean(batches, axis=0), noise_of_responses(batches)
    if not (fine.any() or indirect.any()) and _is_lit(traced):
        return UNKNOWN
    if traced.indirect.unfiltered is not None:
        bias = _filter_bias(batches, traced.indirect.unfiltered, place)
    # few pixels hold the rare bright paths, and few may hold most of the light: all pixels' totals say how typical the
    # checked ones are
    variance = traced.indirect.noise**2
    total = np.bincount(traced.samples.pixel, weights=traced.samples.radiance, minlength=len(variance))
    brightness = _over_checked(np.maximum(total**2 - variance, 0), checked) or 1.0
    clamped = _lost_to_clamp(traced.indirect.removed, checked)
    errors = IndirectErrors(
        noise, merging, bias, clamped, _over_checked(variance, checked) / brightness, 1 / brightness, plan.left_out
    )
    error = estimate(coarse, fine, indirect, errors, checked.weight)
    return replace(error, worst_share=worst_fraction_of(traced.indirect.noise, error))


def _is_lit(traced: LightSamples) -> bool:
    return bool(traced.samples.radiance.any())


def _may_have_missed_all(world: TracedScene, plan: Plan, traced: LightSamples) -> bool:
    """Return whether a pilot found no light at all although what is seen reflects some."""
    if plan.bounces == 1 or traced.indirect is not None or _is_lit(traced):
        return False
    return bool((centre_layers(world).albedo > 0).any())


def _finer(world: TracedScene, plan: Plan, checked: CheckedPixels) -> np.ndarray:
    """Return direct light of the checked pixels by clearly more rays than the plan's; of the pilot's it is known."""
    fine = finer_pilot(world, checked.pilot, plan.grid, plan.edge_threshold)
    if len(checked.added) == 0:
        return fine
    both = np.concatenate([fine, finer_pilot(world, checked.added, plan.grid, plan.edge_threshold)])
    return both[np.argsort(np.concatenate([checked.pilot, checked.added]))]


def _over_checked(values: np.ndarray, checked: CheckedPixels) -> float:
    """Return the mean of all pixels' values (H*W,) over what the checked ones say it is; 1 where these have none."""
    of_checked = checked.mean(values)
    return float(values.mean()) / of_checked if of_checked > 0 else 1.0


def _lost_to_clamp(removed: RemovedLight | None, checked: CheckedPixels) -> np.ndarray | float:
    """Compute the squared error of the checked pixels by what a clamp removed: that of their regions, in the mean the
    image's."""
    if removed is None:
        return 0.0
    squared_error = removed.squared_error()
    whole, local = max(float(squared_error.mean()), 0.0), np.maximum(squared_error, 0)
    of_checked = checked.mean(local)
    return local[checked.pixel] * (whole / of_checked) if of_checked > 0 else np.full(len(checked.pixel), whole)


def _filter_bias(filtered: list[np.ndarray], unfiltered: ProbePixels, place: np.ndarray) -> np.ndarray | float:
    """Compute the squared difference that the filter makes, per pixel, from two independent halves of the batches.

    What noise adds to it has mean 0; 0 where the sum is not CLEAR standard deviations above that.
    """
    if len(filtered) < 2:
        return 0.0
    changes = [
        np.mean(filtered[half], axis=0) - response(unfiltered.samples(half), place)
        for half in (slice(0, None, 2), slice(1, None, 2))
    ]
    squared = (changes[0] * changes[1]).sum(axis=1)
    return squared if squared.sum() > CLEAR * math.sqrt((squared**2).sum()) else 0.0
