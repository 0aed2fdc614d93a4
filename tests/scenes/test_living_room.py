"""The demo room: closed, furnished, in proportion, and the same bytes for the same seed."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from triangles import hit_distances

from scenes import InputError, Scene, Texture
from scenes.library.living_room import HIGH, LOW, living_room
from scenes.library.things.basic_furniture import RUG_M

SEEDS = (0, 1, 2, 3)


@cache
def room(seed: int) -> Scene:
    return living_room(seed)


def test_distance_helper_agrees_with_a_known_wall():
    scene = room(0)
    walls = [s for s in scene.surfaces if s.name in ("floor", "ceiling", "walls")]
    empty = Scene("empty room", tuple(walls), scene.camera)
    down, ahead = hit_distances(empty, np.array([(0.0, -1.0, 0.0), (0.0, 0.0, -1.0)]))
    assert down == pytest.approx(scene.camera.origin[1])
    assert ahead == pytest.approx(scene.camera.origin[2] - LOW[2])


def bounds_by_piece(scene: Scene) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Bounding box of each piece of furniture; a piece is what stands before the colon in its surfaces' names."""
    points: dict[str, list[np.ndarray]] = {}
    for surface in scene.surfaces:
        if ":" in surface.name:
            points.setdefault(surface.name.split(":")[0], []).append(surface.vertices)
    stacked = {name: np.concatenate(parts) for name, parts in points.items()}
    return {name: (p.min(axis=0), p.max(axis=0)) for name, p in stacked.items()}


def test_same_seed_same_bytes_other_seed_other_scene():
    assert living_room(5).digest() == living_room(5).digest()
    assert len({room(seed).digest() for seed in SEEDS}) == len(SEEDS)


def test_image_size_changes_only_the_camera():
    small = living_room(0, width=40, height=30)
    assert (small.camera.width, small.camera.height) == (40, 30)
    assert small.camera.fov_deg == room(0).camera.fov_deg
    pairs = zip(small.surfaces, room(0).surfaces, strict=True)
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in pairs)


@pytest.mark.parametrize("seed", [-1, 1.5, "seven", None])
def test_refuses_a_seed_that_is_no_whole_number(seed):
    with pytest.raises(InputError, match=r"^living-room: seed [^\n]* is not a whole number of 0 or more$"):
        living_room(seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_depths_fill_the_range_and_the_image(seed):
    scene = room(seed)
    depth = hit_distances(scene, scene.camera.resized(32, 24).rays().reshape(-1, 3))
    assert np.isfinite(depth).all()
    # 32 x 24 rays may miss the nearest corner by a little, hence the wider upper limit on the minimum
    assert 0.8 <= depth.min() <= 1.1
    assert 2.5 <= np.median(depth) <= 3.5
    assert 5.5 <= depth.max() <= 6.2


@pytest.mark.parametrize("seed", SEEDS)
def test_camera_inside_with_nothing_close(seed):
    scene = room(seed)
    assert (scene.camera.origin > LOW + 0.5).all() and (scene.camera.origin < HIGH - 0.5).all()
    assert scene.camera.origin[1] == pytest.approx(1.4)
    assert scene.camera.rotation[1, 2] < 0, "the camera looks slightly down"
    vertices = np.concatenate([s.vertices for s in scene.surfaces])
    assert np.linalg.norm(vertices - scene.camera.origin, axis=1).min() > 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_everything_is_inside_and_nothing_cuts_into_anything_else(seed):
    pieces = bounds_by_piece(room(seed))
    for name, (low, high) in pieces.items():
        assert (low >= LOW - 1e-9).all() and (high <= HIGH + 1e-9).all(), name
    for (name, (low, high)), (other, (other_low, other_high)) in combinations(pieces.items(), 2):
        overlap = np.minimum(high, other_high) - np.maximum(low, other_low)
        assert overlap.min() <= 1e-9, f"{name} and {other} overlap by {overlap}"


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_floats(seed):
    pieces = bounds_by_piece(room(seed))
    stands_at = {"ball": RUG_M, "sculpture": pieces["table"][1][1]}
    for name in pieces.keys() - {"picture", "window"}:
        assert pieces[name][0][1] == pytest.approx(stands_at.get(name, 0.0), abs=1e-9), name
    assert pieces["picture"][0][0] == pytest.approx(LOW[0])
    assert pieces["window"][0][2] == pytest.approx(LOW[2])
    for name, support in (("sculpture", "table"), ("ball", "rug")):
        middle = np.mean(pieces[name], axis=0)[::2]
        low, high = pieces[support]
        assert (middle > low[::2]).all() and (middle < high[::2]).all(), f"{name} is on the {support}"


def test_proportions_of_furniture():
    pieces = bounds_by_piece(room(0))
    tall = {name: high[1] - low[1] for name, (low, high) in pieces.items()}
    assert 0.7 < tall["table"] < 0.8 and 0.85 < tall["chair"] < 1.1 and 0.7 < tall["sofa"] < 1.0
    assert 1.4 < tall["lamp"] < 1.8 and 1.8 < tall["bookshelf"] < 2.2
    stand = next(s for s in room(0).surfaces if s.name == "lamp: stand")
    foot = stand.vertices[stand.vertices[:, 1] < 0.03][:, ::2]
    radii = np.linalg.norm(foot - (foot.min(axis=0) + foot.max(axis=0)) / 2, axis=1)
    assert 0.008 <= radii[radii > 1e-6].min() <= 0.01, "the stand is thin"


def test_materials_are_shared_varied_and_textured():
    scene = room(0)
    materials = {id(s.material): s.material for s in scene.surfaces}.values()
    assert len({m.name for m in materials}) == len(materials) < len(scene.surfaces), "equal materials are one object"
    diffuse = [m.albedo for m in materials if m.kind != "roughconductor"]
    images = [a.image for a in diffuse if isinstance(a, Texture)]
    assert len(images) >= 5
    low = min(a.image.min() if isinstance(a, Texture) else a for a in diffuse)
    high = max(a.image.max() if isinstance(a, Texture) else a for a in diffuse)
    assert low == pytest.approx(0.05, abs=0.02) and high == pytest.approx(0.9, abs=1e-6)
    assert {m.kind for m in materials} == {"diffuse", "roughplastic", "roughconductor"}


def test_ambient_comes_from_window_and_lamp_and_faces_the_room():
    scene = room(0)
    lights = {s.name: s for s in scene.surfaces if s.emission > 0}
    assert set(lights) == {"window: panes", "lamp: shade"} and scene.has_ambient
    a, b, c = lights["window: panes"].vertices[lights["window: panes"].faces].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    shade = lights["lamp: shade"]
    a, b, c = shade.vertices[shade.faces].transpose(1, 0, 2)
    outward = (a + b + c) / 3 - shade.vertices.mean(axis=0)
    assert ((np.cross(b - a, c - a) * outward)[:, ::2].sum(axis=1) > 0).all()


def test_size_and_shading_normals():
    scene = room(0)
    assert 5_000 < scene.triangles < 60_000
    smooth = [s for s in scene.surfaces if s.normals is not None]
    assert {s.name for s in smooth} == {"ball: rubber", "sculpture: clay"}
    for surface in smooth:
        assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1)
        a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
        across = np.cross(b - a, c - a)
        agree = (across * surface.normals[surface.faces].sum(axis=1)).sum(axis=1)
        assert (agree[np.linalg.norm(across, axis=1) > 1e-12] > 0).mean() > 0.99
