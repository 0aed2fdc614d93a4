"""Samples of light -> a dense histogram: what the renderer is timed to, since its peer can make nothing else."""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import Floats, UInts
from render.scene.traced_scene import Float, UInt32, dr, mi, upload
from render.transient.samples import Samples


def binned(samples: Samples, pixels: int, bins: int, bin_m: float) -> np.ndarray:
    """Return radiance per pixel and bin, (pixels, bins) float32; bin i covers path lengths [i, i + 1) * bin_m.

    A sample is uniform over path +- half width (a point where that is 0) and gives each bin its share of the interval;
    what lies outside [0, bins * bin_m) is dropped. Scattered by as many threads as the peer scatters with.
    """
    if len(samples.pixel) == 0:
        return np.zeros((pixels, bins), np.float32)
    intervals = (upload(Float, values) for values in (samples.path_m, samples.half_width_m, samples.radiance))
    numbers = dr.opaque(UInt32, bins), dr.opaque(Float, bin_m)
    out = _scattered(upload(UInt32, samples.pixel), *intervals, *numbers, pixels * bins)
    dr.eval(out)
    return out.numpy().reshape(pixels, bins)


@dr.freeze
@dr.syntax
def _scattered(
    pixel: UInts, path: Floats, half_width: Floats, radiance: Floats, bins: UInts, bin_m: Floats, size: int
) -> Floats:
    out = dr.zeros(Float, size)
    # a point on an edge belongs to the bin above it: the division must not round it down
    near, far = (path - half_width) / bin_m, (path + half_width) / bin_m
    place = dr.maximum(mi.Int32(dr.floor(near)), 0)
    last = dr.minimum(mi.Int32(dr.floor(far)), mi.Int32(bins) - 1)
    point = far == near
    density = dr.select(point, radiance, radiance / (far - near))
    while place <= last:
        overlap = dr.minimum(far, Float(place) + 1) - dr.maximum(near, Float(place))
        fraction = dr.select(point, 1, overlap)
        dr.scatter_reduce(dr.ReduceOp.Add, out, density * fraction, pixel * bins + UInt32(place))
        place += 1
    return out
