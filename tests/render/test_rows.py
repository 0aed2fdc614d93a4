"""Arrays by row hold what their columns held."""

import numpy as np
import pytest

from render.scene.rays import camera_rays, interaction_from_parts, parts_of
from render.scene.rows import INTERACTION, PLACE_ON_SURFACE, WIDTH, gather_rows, packed
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi
from scenes.library.rooms import room_view

ENTRIES, LANES = 1001, 500


def leaves(column) -> list[np.ndarray]:
    """Numbers of a column, each as it lies in memory."""
    if isinstance(column, mi.Frame3f):
        return [values for axis in (column.s, column.t, column.n) for values in leaves(axis)]
    return [part.numpy() for part in column] if dr.depth_v(column) > 1 else [column.numpy()]


def drawn(count: int, seed: int = 0) -> list:
    """One column of every kind that is not a part of a surface."""
    draw = np.random.default_rng(seed)
    numbers = [Float(draw.normal(size=count).astype(np.float32)) for _ in range(3)]
    return [
        mi.Vector3f(*numbers),
        UInt32(draw.integers(0, 1 << 32, count, dtype=np.uint32)),
        Bool(draw.random(count) < 0.5),
        mi.Point2f(*numbers[:2]),
        numbers[2],
    ]


@pytest.mark.parametrize("chosen", [False, True])
def test_columns_come_back_as_they_were(chosen: bool) -> None:
    draw, columns = np.random.default_rng(1), drawn(ENTRIES)
    index = UInt32(draw.integers(0, ENTRIES // 3, LANES).astype(np.uint32))
    some = UInt32(draw.integers(0, ENTRIES, ENTRIES // 3).astype(np.uint32)) if chosen else None
    active = Bool(draw.random(LANES) < 0.7)
    rows = packed(columns, some)
    assert len(rows) == 1 and dr.width(rows[0]) == WIDTH * (ENTRIES // 3 if chosen else ENTRIES)
    source = index if some is None else dr.gather(UInt32, some, index)
    found = gather_rows(rows, [type(column) for column in columns], index, active)
    for got, column in zip(found, columns, strict=True):
        assert isinstance(got, type(column))
        expected = dr.gather(type(column), column, source, active)
        for one, other in zip(leaves(got), leaves(expected), strict=True):
            assert np.array_equal(one, other)


@pytest.mark.parametrize("kinds", [INTERACTION, PLACE_ON_SURFACE], ids=["seen", "unseen"])
def test_surfaces_come_back_as_they_were(kinds: tuple) -> None:
    """Shapes and shading frames, too: the third axis is not kept, and is the cross product of the others."""
    world = TracedScene(room_view(3, width=24, height=18))
    pixel = dr.arange(UInt32, 24 * 18)
    ray, _ = camera_rays(world, Float(pixel % 24) + 0.5, Float(pixel // 24) + 0.5)
    si = world.mi_scene.ray_intersect(ray)
    columns = parts_of(si)[: len(kinds)]
    found = gather_rows(packed(columns), kinds, pixel, True)
    for got, column in zip(found, columns, strict=True):
        for one, other in zip(leaves(got), leaves(column), strict=True):
            if one.dtype == np.float32:
                np.testing.assert_allclose(one, other, atol=1e-6)
            else:
                assert np.array_equal(one, other)
    again = interaction_from_parts(found)
    assert np.array_equal(again.shape.numpy(), si.shape.numpy())
