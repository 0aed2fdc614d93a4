"""Returns of one pixel made fewer, where no pulse of a stated length could tell: energy, centroid and variance stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from render.transient import Transient
from scenes.constants import REFERENCE_PULSE_SIGMA_S, SPEED_OF_LIGHT_M_PER_S

PULSE_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PULSE_SIGMA_S


def thinned(view: Transient, error: float) -> Transient:
    """Return the transient with neighbouring direct returns of a pixel merged into one uniform return each.

    A group of returns and the uniform one of equal energy, mean and variance differ from the third moment on. After a
    Gaussian pulse of standard deviation s, the first two terms of that difference are the pulse's third derivative
    times m3 / 6 and its fourth times (m4 - w^4 / 80) / 24; their norms are sqrt(15/8) / s^3 and sqrt(105/16) / s^4
    times the pulse's own. Groups grow, in the order of paths, while their share of the pixel's energy times the norm
    of both stays below `error`.
    Indirect returns stay as they are.
    """
    pixel, direct = view.return_pixel, view.bounces == 1
    group = _groups(view, pixel, direct, error)
    near, far = view.path_near_m.astype(np.float64), view.path_far_m.astype(np.float64)
    count = int(group.max(initial=-1)) + 1
    first = np.zeros(count, np.int64)
    first[group[::-1]] = np.arange(len(group))[::-1]
    single = np.bincount(group, minlength=count) == 1
    energy = np.bincount(group, view.radiance, count)
    # a group without energy keeps its first return
    weight = np.where(energy[group] > 0, view.radiance, 0) / np.where(energy > 0, energy, 1)[group]
    base, centre = near[first], (near + far) / 2
    offset = centre - base[group]
    mean = np.bincount(group, weight * offset, count)
    spread = np.bincount(group, weight * ((offset - mean[group]) ** 2 + (far - near) ** 2 / 12), count)
    half = np.sqrt(3 * spread)
    kept = single | (energy == 0)
    new_near = np.where(kept, near[first], np.maximum(base + mean - half, 0)).astype(np.float32)
    new_far = np.where(kept, far[first], base + mean + half).astype(np.float32)
    order = np.lexsort((new_near, pixel[first]))
    counts = np.bincount(pixel[first], minlength=view.height * view.width)
    return replace(
        view,
        offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        path_near_m=new_near[order],
        path_far_m=np.maximum(new_far, new_near)[order],
        radiance=energy.astype(np.float32)[order],
        bounces=view.bounces[first][order],
        meta={**view.meta, "thinned": error},
    )


def _groups(view: Transient, pixel: np.ndarray, direct: np.ndarray, error: float) -> np.ndarray:
    """Find the group of every return, numbered in their order; the k-th returns of all pixels are looked at
    together."""
    near, far = view.path_near_m.astype(np.float64), view.path_far_m.astype(np.float64)
    total = np.maximum(np.bincount(pixel, view.radiance, view.height * view.width), np.finfo(float).tiny)
    opens = np.ones(view.returns, bool)
    rows = np.flatnonzero(direct)
    start = np.searchsorted(pixel[rows], np.arange(view.height * view.width + 1))
    sums, base = np.zeros((5, len(total))), np.zeros(len(total))
    for rank in range(int(np.diff(start).max(initial=0))):
        here = np.flatnonzero(np.diff(start) > rank)
        row = rows[start[here] + rank]
        base[here] = np.where(sums[0, here] > 0, base[here], near[row])
        joint = sums[:, here] + _moments(
            (near[row] + far[row]) / 2 - base[here], (far - near)[row] / 2, view.radiance[row]
        )
        merges = (rank > 0) & (_blurred(joint) * joint[0] <= error * total[here])
        opens[row] = ~merges
        alone = _moments((far - near)[row] / 2, (far - near)[row] / 2, view.radiance[row])
        base[here] = np.where(merges, base[here], near[row])
        sums[:, here] = np.where(merges, joint, alone)
    # direct and indirect returns of a pixel may alternate: a direct one joins the last direct group
    number = np.cumsum(opens) - 1
    last_open = np.maximum.accumulate(np.where(direct & opens, np.arange(len(opens)), 0))
    return number[np.where(opens, np.arange(len(opens)), last_open)]


def _moments(centre: np.ndarray, half: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Compute energy times the raw moments 0 to 4 of uniform returns, (5, n)."""
    square = half**2
    powers = (
        np.ones_like(centre),
        centre,
        centre**2 + square / 3,
        centre**3 + centre * square,
        centre**4 + 2 * centre**2 * square + square**2 / 5,
    )
    return np.stack(powers) * energy


def _blurred(sums: np.ndarray) -> np.ndarray:
    """Compute the norm of the difference between a group and its uniform return after the pulse, as a share of the
    group's own."""
    energy = np.maximum(sums[0], np.finfo(float).tiny)
    m1, m2, m3, m4 = sums[1:] / energy
    variance = np.maximum(m2 - m1**2, 0)
    third = m3 - 3 * m1 * m2 + 2 * m1**3
    fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
    excess = fourth - 1.8 * variance**2  # w^4 / 80 of a uniform return, whose variance is w^2 / 12
    return np.hypot(third / 6 * np.sqrt(15 / 8) / PULSE_M**3, excess / 24 * np.sqrt(105 / 16) / PULSE_M**4)
