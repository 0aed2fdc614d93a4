"""Samples of light -> a dense histogram: what the renderer is timed to, since its peer can make nothing else."""

from __future__ import annotations

import numpy as np

from render.returns import Samples


def binned(samples: Samples, pixels: int, bins: int, bin_m: float, *, out: np.ndarray | None = None) -> np.ndarray:
    """Radiance per pixel and bin, (pixels, bins) float32; bin i covers path lengths [i, i + 1) * bin_m.

    A sample is uniform over path +- half width (a point where that is 0) and gives each bin its share of the interval,
    exactly; what lies outside [0, bins * bin_m) is dropped. `out` is an array to fill again instead of a new one, as
    Dr.Jit keeps the memory of the peer's tensor from call to call.
    """
    if out is None:
        out = np.zeros((pixels, bins), np.float32)
    else:
        out.fill(0)
    flat = out.reshape(-1)
    near = (samples.path_m - samples.half_width_m) / bin_m
    far = (samples.path_m + samples.half_width_m) / bin_m
    first, last = np.floor(near).astype(np.int64), np.floor(far).astype(np.int64)
    row = samples.pixel * np.int64(bins)
    _add(flat, row, first, samples.radiance, bins, first == last)
    wide = np.flatnonzero(first != last)
    if len(wide):
        near, far, first, last, row = near[wide], far[wide], first[wide], last[wide], row[wide]
        density = samples.radiance[wide] / (far - near)  # per bin
        _add(flat, row, first, density * (first + 1 - near), bins)
        _add(flat, row, last, density * (far - last), bins)
        _add_inner(flat, row, first + 1, last, density, bins)
    return out


def _add(
    flat: np.ndarray, row: np.ndarray, bin_: np.ndarray, energy: np.ndarray, bins: int, chosen: np.ndarray | bool = True
) -> None:
    """Add to one bin each, where it is inside."""
    inside = (bin_ >= 0) & (bin_ < bins) & chosen
    if not inside.all():
        inside = np.flatnonzero(inside)  # numpy picks by index much faster than by mask
        row, bin_, energy = row[inside], bin_[inside], energy[inside]
    np.add.at(flat, row + bin_, energy.astype(np.float32))


def _add_inner(
    flat: np.ndarray, row: np.ndarray, start: np.ndarray, stop: np.ndarray, density: np.ndarray, bins: int
) -> None:
    """Add `density` to every bin of [start, stop), the bins that an interval covers whole."""
    start, stop = np.maximum(start, 0), np.minimum(stop, bins)
    some = np.flatnonzero(stop > start)
    start, length = start[some], (stop - start)[some]
    ends = np.cumsum(length)
    total = int(ends[-1]) if len(ends) else 0
    index = np.arange(total) + np.repeat(row[some] + start - (ends - length), length)
    np.add.at(flat, index, np.repeat(density[some].astype(np.float32), length))
