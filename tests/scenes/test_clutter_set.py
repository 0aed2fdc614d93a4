"""Clutter: closed, edge-rich views of their own, the same bytes for the same number, one kernel for all of them."""

from functools import cache

import numpy as np
import pytest

from scenes import InputError, Scene, Texture
from scenes.library.catalog import load_scene
from scenes.library.clutter_set import NEAREST_M, clutter_view
from scenes.library.sets import scene_set
from scenes.library.things.edge_shapes import MAKERS, merged, random_rotation

VIEWS = range(8)


@cache
def view(index: int, split: str = "train") -> Scene:
    return clutter_view(index, split, width=48, height=48)


@cache
def depth(index: int) -> np.ndarray:
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene

    return centre_layers(TracedScene(view(index))).depth_m


def test_equal_numbers_give_equal_bytes_and_others_other_views():
    assert clutter_view(3, width=48, height=48).digest() == view(3).digest()
    digests = {view(i).digest() for i in VIEWS} | {view(i, "val").digest() for i in VIEWS}
    digests |= {clutter_view(i, seed=1, width=48, height=48).digest() for i in VIEWS}
    assert len(digests) == 3 * len(VIEWS)


def test_names_lead_to_views_and_a_wrong_one_is_one_line():
    assert load_scene("clutter/val/2", width=48, height=48).digest() == view(2, "val").digest()
    assert scene_set("clutter").name == "clutter/train"
    for spec in ("clutter/train", "clutter/nowhere/1"):
        with pytest.raises(InputError, match=r"^[^\n]*expected[^\n]*$"):
            load_scene(spec)


@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.__name__)
def test_shapes_are_finite_fill_about_the_unit_ball_and_have_texture_coordinates(maker):
    for seed in range(20):
        vertices, faces, uv = maker(np.random.default_rng(seed))
        assert np.isfinite(vertices).all() and 0.2 < np.abs(vertices).max() < 3
        assert uv.min() >= 0 and uv.max() <= 1 and len(uv) == len(vertices)
        assert faces.min() >= 0 and faces.max() < len(vertices)


def test_merged_shapes_keep_their_triangles():
    parts = [maker(np.random.default_rng(1)) for maker in MAKERS]
    vertices, faces, _ = merged(parts)
    expected = np.concatenate([part[0][part[1]] for part in parts])
    assert np.array_equal(vertices[faces], expected)


def test_random_rotations_are_rotations_without_a_preferred_direction():
    rng = np.random.default_rng(0)
    drawn = np.array([random_rotation(rng) for _ in range(4000)])
    assert np.allclose(drawn @ drawn.transpose(0, 2, 1), np.eye(3)) and np.allclose(np.linalg.det(drawn), 1)
    # entries have mean 0 and variance 1/3: five standard errors, for nine of them
    assert np.abs(drawn.mean(axis=0)).max() < 5 * (3 * 4000) ** -0.5


def test_every_view_is_closed_and_nothing_is_nearer_than_the_limit():
    for i in VIEWS:
        assert np.isfinite(depth(i)).all(), "a ray left the room"
        assert depth(i).min() >= NEAREST_M


def edge_fraction(seen: np.ndarray) -> float:
    """Fraction of the pixels where depth bends by more than 0.1 m over three pixels in a row or column."""
    edge = np.zeros(seen.shape, bool)
    edge[1:-1] |= np.abs(np.diff(seen, 2, axis=0)) > 0.1
    edge[:, 1:-1] |= np.abs(np.diff(seen, 2, axis=1)) > 0.1
    return float(edge.mean())


def test_many_pixels_lie_at_depth_edges():
    """The set's purpose: a third of its pixels, while rooms of this size have a fifth."""
    assert np.mean([edge_fraction(depth(i)) for i in VIEWS]) > 0.3


def test_materials_of_all_views_are_of_the_same_kinds():
    """What the renderer compiles kernels for, as of rooms."""

    def kinds(scene: Scene) -> set[tuple]:
        materials = [(s.material, s) for s in scene.surfaces]
        return {
            (m.kind, m.roughness, m.ior, m.k, isinstance(m.albedo, Texture), s.emission > 0, s.normals is None)
            for m, s in materials
        }

    assert len({frozenset(kinds(view(i))) for i in VIEWS}) == 1
    images = {id(s.material.albedo) for s in view(0).surfaces if isinstance(s.material.albedo, Texture)}
    assert len(images) == 1


@pytest.mark.slow
def test_depths_of_two_hundred_views():
    """From arm's length to the end of a hall: nothing under 0.3 m, most within rooms' depths, some beyond 8 m."""
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene

    seen = np.array([centre_layers(TracedScene(clutter_view(i, width=32, height=32))).depth_m for i in range(200)])
    assert np.isfinite(seen).all() and seen.min() >= NEAREST_M and seen.max() < 26
    assert 1.5 < np.median(seen) < 3.5 and 0.05 < (seen > 6.3).mean() < 0.3 and (seen > 8).mean() > 0.02
