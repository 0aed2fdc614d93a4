"""Rooms: closed, furnished, varied, the same bytes for the same number, depths of an indoor data set."""

import itertools
from functools import cache

import numpy as np
import pytest

from scenes import InputError, Scene, Texture
from scenes.library.catalog import load_scene
from scenes.library.layout import Boxes, overlap, set_down
from scenes.library.rooms import VIEWS_PER_ROOM, pieces, room_of, room_view
from scenes.library.sets import scene_set
from scenes.library.things.parts import Piece, box, joined, panel
from scenes.library.things.patterns import on_one_sheet
from scenes.model import Material

VIEWS = (0, 5, 10, 15)  # of four rooms


@cache
def view(index: int, split: str = "train") -> Scene:
    return room_view(index, split, width=32, height=24)


@cache
def depth(index: int) -> np.ndarray:
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene

    return centre_layers(TracedScene(view(index))).depth_m


def test_equal_numbers_give_equal_bytes_and_others_other_rooms():
    assert room_view(3, width=32, height=24).digest() == view(3).digest()
    digests = {view(i).digest() for i in VIEWS} | {view(i, "val").digest() for i in VIEWS}
    assert len(digests) == 2 * len(VIEWS)
    assert room_view(3, seed=1, width=32, height=24).digest() != view(3).digest()


def test_a_room_is_seen_by_cameras_that_differ_clearly():
    """Its surfaces are the same objects; any two cameras are half a metre and 30 degrees apart."""
    chosen = scene_set("rooms")
    for room in range(3):
        numbers = range(room * VIEWS_PER_ROOM, (room + 1) * VIEWS_PER_ROOM)
        views = [chosen.view(i, width=16, height=12) for i in numbers]
        assert len({chosen.place(i) for i in numbers}) == 1 and len({v.digest() for v in views}) == len(views)
        for a, b in itertools.combinations(views, 2):
            assert a.surfaces is b.surfaces
            assert np.linalg.norm(a.camera.origin - b.camera.origin) > 0.5
            assert a.camera.rotation[:, 2] @ b.camera.rotation[:, 2] < np.cos(np.radians(30))
    assert chosen.place(0) != chosen.place(VIEWS_PER_ROOM) and chosen.views_per_place == VIEWS_PER_ROOM
    assert scene_set("rooms/val").place(0) != chosen.place(0)


def test_a_view_does_not_depend_on_what_was_made_before():
    room_of.cache_clear()
    alone = room_view(6, width=16, height=12).digest()
    for i in (0, 9, 13):
        room_view(i, width=16, height=12)
    assert room_view(6, width=16, height=12).digest() == alone


def test_boxes_are_hit_where_rays_enter_them():
    """Slabs against the closed form: a turned square box ahead, beside, above, and around the origin."""
    place = set_down(Piece((joined("box", Material(), box((-1, 0, -1), (1, 2, 1))),)), 0, 5, turn_deg=45)
    boxes = Boxes([place])
    rays = np.array([(0, 0, 1), (1, 0, 0), (0, 1, 0), (0.1, 0, 1)], float)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = boxes.distance(np.array((0, 1.0, 0)), rays)[:, 0]
    edge = 5 - np.sqrt(2)
    # the side from (0, edge) to (sqrt 2, 5) is x - z = -edge
    assert distance == pytest.approx([edge, np.inf, np.inf, edge / 0.9 * np.hypot(0.1, 1)])
    inside = boxes.distance(np.array((0, 1.0, 5.0)), rays)[:, 0]
    assert inside[:3] == pytest.approx([np.sqrt(2), np.sqrt(2), 1])


def test_heads_meet_the_boxes_that_their_squares_overlap():
    """All heads and boxes at once against one pair of convex polygons at a time."""
    draw = np.random.default_rng(1)
    piece = Piece((joined("box", Material(), box((-0.3, 0, -0.6), (0.3, 1, 0.6))),))
    places = [
        set_down(piece, *draw.uniform(-3, 3, 2), y=draw.uniform(0, 2), turn_deg=draw.uniform(0, 360)) for _ in range(9)
    ]
    points, y = draw.uniform(-3, 3, (300, 2)), draw.uniform(0.9, 1.75, 300)
    square = 0.28 * np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    met = [
        any(p.high > 0.5 * h and p.low < h + 0.2 and overlap(at + square, p.plan) for p in places)
        for at, h in zip(points, y, strict=True)
    ]
    assert Boxes(places).meet_head(points, 0.28, y, 0.2).tolist() == met and 60 < sum(met) < 240


@pytest.mark.parametrize("index", VIEWS)
def test_every_view_is_closed_and_has_indoor_depths(index):
    seen = depth(index)
    assert np.isfinite(seen).all(), "a ray left the room"
    assert seen.min() > 0.3 and np.quantile(seen, 0.99) < 7.5 and 1.0 < np.median(seen) < 5.0


def test_materials_of_all_views_are_of_the_same_kinds():
    """What the renderer compiles kernels for: kinds, parameters, textures, lights."""

    def kinds(scene: Scene) -> set[tuple]:
        found = set()
        for s in scene.surfaces:
            m = s.material
            found.add(
                (m.kind, m.roughness, m.ior, m.k, isinstance(m.albedo, Texture), s.emission > 0, s.normals is None)
            )
        return found

    assert len({frozenset(kinds(view(i))) for i in VIEWS}) == 1
    images = {id(s.material.albedo) for s in view(0).surfaces if isinstance(s.material.albedo, Texture)}
    assert len(images) == 1
    assert len({s.emission for s in view(0).surfaces}) <= 3


def test_albedos_lie_in_their_range_and_vary():
    values = [s.material.albedo for i in VIEWS for s in view(i).surfaces]
    plain = np.array([v for v in values if not isinstance(v, Texture)])
    images = [v.image for v in values if isinstance(v, Texture)]
    assert plain.min() >= 0.03 and plain.max() <= 0.95 and plain.min() < 0.06 and plain.max() > 0.8
    assert min(i.min() for i in images) >= 0.0299 and max(i.max() for i in images) <= 0.9501


def test_many_kinds_of_things():
    assert len(set.union(*(pieces(view(i)) for i in VIEWS))) > 25
    assert min(len(pieces(view(i))) for i in VIEWS) >= 8


def test_textures_on_one_sheet_keep_their_texels():
    """A plain texture, looked up through the sheet at the surface's new coordinates, has its value all over."""
    surfaces = []
    for value, side in ((0.2, 512), (0.4, 256), (0.6, 256), (0.7, 128), (0.9, 128)):
        material = Material(albedo=Texture(np.full((side, side), value, np.float32), f"{value}"))
        surfaces.append(joined("panel", material, panel((0, 0, 0), (1, 0, 0), (0, 1, 0))))
    moved = on_one_sheet(surfaces)
    assert len({id(s.material.albedo) for s in moved}) == 1
    for before, after in zip(surfaces, moved, strict=True):
        image = after.material.albedo.image
        rng = np.random.default_rng(0)
        u, v = (after.uv.min(axis=0) + rng.random((50, 2)) * np.ptp(after.uv, axis=0)).T
        texel = image[((1 - v) * image.shape[0]).astype(int), (u * image.shape[1]).astype(int)]
        assert texel == pytest.approx(before.material.albedo.image[0, 0])


def test_names_lead_to_views_and_wrong_ones_are_one_line():
    assert load_scene("rooms/val/2", width=32, height=24).digest() == view(2, "val").digest()
    assert load_scene("rooms/train/1").name == "rooms/train/1"
    for spec in ("rooms/train", "rooms/train/x", "rooms/nowhere/1", "tabletop/none"):
        with pytest.raises(InputError, match=r"^[^\n]*expected[^\n]*$"):
            load_scene(spec)
    with pytest.raises(InputError, match="outside"):
        scene_set("tabletop").view(8)


def test_tabletop_scenes_are_named_fixed_and_in_range():
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene
    from scenes.library.tabletop import SCENES, tabletop

    assert len(SCENES) == 8
    for name in SCENES:
        scene = tabletop(name, width=44, height=36)
        assert scene.name == f"tabletop/{name}" and scene.digest() == tabletop(name, width=44, height=36).digest()
        # traces of light from where none is seen would be all the ambient light, in a few pixels
        assert not scene.has_ambient
        seen = centre_layers(TracedScene(scene)).depth_m
        assert seen.min() >= 1.1 and seen.max() <= 2.9 and np.median(seen) < 2.6


@pytest.mark.slow
def test_depths_of_two_hundred_views():
    """Quantiles as NYUv2's: 0.5 to 7 m, median 2 to 3.5 m, under 1 % beyond 7 m; no view with over 2 % empty pixels."""
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene

    seen = np.array([centre_layers(TracedScene(room_view(i, width=32, height=32))).depth_m for i in range(200)])
    assert np.isnan(seen).mean(axis=1).max() <= 0.02
    assert np.nanquantile(seen, 0.001) >= 0.5 and 2.0 <= np.nanmedian(seen) <= 3.5 and np.nanmean(seen > 7) < 0.01
    assert len({row.tobytes() for row in seen}) == 200
