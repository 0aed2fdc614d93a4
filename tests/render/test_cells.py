"""Cells of indirect light keep energy, place and spread, however few paths they hold."""

from itertools import pairwise

import numpy as np
import pytest

from render.indirect.path_cells import MomentHistogram, coarsened, make_cells
from render.scene.traced_scene import Bool, Float, UInt32, dr, upload
from render.transient.samples import Samples, packed


def samples_of(rows: MomentHistogram, pixels: int = 1) -> Samples:
    dr.eval(rows.moments)
    return rows.samples(np.arange(pixels), np.zeros(pixels))


def second_moment(samples: Samples) -> float:
    path, half = (column.astype(float) for column in (samples.path_m, samples.half_width_m))
    return float(np.average(path**2 + half**2 / 3, weights=samples.radiance))


@pytest.mark.parametrize("growth", [0.0, 0.05])
def test_light_between_two_paths_keeps_its_energy_and_place(growth):
    """Also beyond the last cell, where an interval reaches past the end of all cells."""
    rng, cells = np.random.default_rng(1), make_cells(0.03, growth, -0.5, 5.0)
    rows = MomentHistogram(1, cells, 2.0**-40)
    low = rng.uniform(-0.6, 5.5, 5000)
    high = low + rng.uniform(0, 0.03, len(low))
    radiance = rng.uniform(0, 1, len(low))
    columns = (upload(Float, part) for part in (low, high, radiance))
    rows.add_between(UInt32(0), *columns, Bool(True))
    energy, _, _ = (values[0] for values in rows.sums())
    assert energy.sum() == pytest.approx(radiance.sum(), rel=1e-6)
    inside = (low > -0.4) & (high < 4.9)
    rows = MomentHistogram(1, cells, 2.0**-40)
    columns = (upload(Float, part[inside]) for part in (low, high, radiance))
    rows.add_between(UInt32(0), *columns, Bool(True))
    energy, moment, _ = (values[0] for values in rows.sums())
    mean = (energy * cells.edges_m[:-1] + moment * cells.width_of_m).sum() / energy.sum()
    low, high, radiance = (part[inside] for part in (low, high, radiance))
    assert mean == pytest.approx(np.average((low + high) / 2, weights=radiance), abs=1e-6)
    spread = np.average((low**2 + low * high + high**2) / 3, weights=radiance)
    assert second_moment(samples_of(rows)) == pytest.approx(spread, rel=1e-5)


@pytest.mark.parametrize("paths", [1, 2, 3, 16])
def test_few_paths_in_a_cell_are_no_bias(paths):
    """Many pixels with few paths each, even over a cell: their samples have the paths' own spread.

    One path stays a point. As the widest interval in its cell, its mean over pixels would be a tent.
    """
    rng, cells, pixels = np.random.default_rng(paths), make_cells(0.1, 0.0, 0.0, 1.0), 4000
    x = rng.uniform(0.5, 0.6, (pixels, paths))
    rows = MomentHistogram(pixels, cells, 2.0**-40)
    rows.add(upload(UInt32, np.repeat(np.arange(pixels), paths)), upload(Float, x.ravel()), Float(1), Bool(True))
    samples = samples_of(rows, pixels)
    assert len(samples.pixel) == pixels and samples.radiance == pytest.approx(paths, rel=1e-6)
    assert second_moment(samples) == pytest.approx((x**2).mean(), rel=1e-6)
    if paths == 1:
        assert samples.path_m == pytest.approx(x.ravel(), abs=1e-6) and (samples.half_width_m < 1e-3 * 0.1).all()
    edges = np.linspace(0.5, 0.6, 5)
    low, high = (samples.path_m + side * np.maximum(samples.half_width_m, 1e-6) for side in (-1, 1))
    parts = [(np.clip(b, low, high) - np.clip(a, low, high)) / (high - low) for a, b in pairwise(edges)]
    # of the cell's quarters; a tent would have 0.125, 0.375, 0.375, 0.125. A little reaches out of the cell
    assert np.abs(np.mean(parts, axis=1) - 0.25).max() < 0.08, np.mean(parts, axis=1)


def test_merging_again_changes_nothing_and_two_rows_add_up():
    """`coarsened` merges samples as the accumulators do."""
    rng, cells = np.random.default_rng(1), make_cells(0.05, 0.05, 0.0, 4.0)
    x, radiance = rng.uniform(0, 4, 500), rng.exponential(1, 500)
    parts = []
    for some in (slice(None), slice(250), slice(250, None)):
        rows = MomentHistogram(1, cells, 2.0**-40)
        rows.add(UInt32(0), upload(Float, x[some]), upload(Float, radiance[some]), Bool(True))
        parts.append(samples_of(rows))
    whole, *halves = parts
    joined = packed(*(np.concatenate(column) for column in zip(*halves, strict=True)))
    for again in (coarsened(joined, cells, np.zeros(1)), coarsened(whole, cells, np.zeros(1))):
        assert again.path_m == pytest.approx(whole.path_m, abs=1e-5)
        assert again.radiance == pytest.approx(whole.radiance, rel=1e-5)
        assert again.half_width_m == pytest.approx(whole.half_width_m, abs=2e-4)
