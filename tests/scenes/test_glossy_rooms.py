"""The hall and the washroom: closed, inside out where they should be, as deep and as glossy as they say."""

from functools import cache

import numpy as np
import pytest
from triangles import hit_distances, open_edges, volume

from scenes import Scene
from scenes.library import hall, washroom
from scenes.library.catalog import load_scene
from scenes.library.things.parts import cloth, creased, joined, rod, solid
from scenes.model import Material

SHELLS = {"hall": ("floor", "ceiling", "walls"), "washroom": ("floor", "ceiling", "tiles", "paint")}
MODULES = {"hall": hall, "washroom": washroom}
DEPTHS_M = {"hall": ((2.3, 2.9), (3.5, 4.2), (6.0, 6.4)), "washroom": ((1.9, 2.5), (3.0, 3.4), (3.7, 3.9))}


@cache
def room(name: str) -> Scene:
    return load_scene(name, width=32, height=24)


def parts(name: str) -> tuple[list, list]:
    """Surfaces of the shell, and all others."""
    shell = [s for s in room(name).surfaces if s.name.split(":")[0] in SHELLS[name]]
    return shell, [s for s in room(name).surfaces if s not in shell]


@pytest.mark.parametrize("name", MODULES)
def test_room_and_bodies_have_no_open_edges(name):
    shell, bodies = parts(name)
    assert open_edges(shell) == 0
    sheets = getattr(MODULES[name], "SHEETS", ())
    assert {s.name for s in bodies if open_edges([s])} == set(sheets)
    assert all(volume(s) > 0 for s in bodies if s.name not in sheets)
    assert sum(map(volume, shell)) == pytest.approx(-np.prod(MODULES[name].HIGH - MODULES[name].LOW))


@pytest.mark.parametrize("name", MODULES)
def test_everything_is_inside_and_the_camera_in_free_air(name):
    low, high = MODULES[name].LOW, MODULES[name].HIGH
    for surface in room(name).surfaces:
        assert (surface.vertices >= low - 0.02).all() and (surface.vertices <= high + 0.02).all(), surface.name
    origin = room(name).camera.origin
    assert (origin > low + 0.2).all() and (origin < high - 0.2).all()
    vertices = np.concatenate([s.vertices for s in room(name).surfaces])
    assert np.linalg.norm(vertices - origin, axis=1).min() > 0.5


@pytest.mark.parametrize("name", MODULES)
def test_depths(name):
    """Of the first opaque surface, as the renderer's depth is."""
    opaque = tuple(s for s in room(name).surfaces if not s.material.is_glass)
    scene = Scene(name, opaque, room(name).camera)
    depth = hit_distances(scene, scene.camera.resized(16, 12).rays().reshape(-1, 3))
    found = np.quantile(depth, (0.01, 0.5, 1.0))
    assert np.isfinite(depth).all()
    for value, (low, high) in zip(found, DEPTHS_M[name], strict=True):
        assert low <= value <= high


def test_the_hall_is_glossy_and_the_washroom_polished():
    def shares(scene: Scene) -> dict[str, float]:
        """Share of the image, by kind of material that each pixel's ray meets first."""
        rays = scene.camera.rays().reshape(-1, 3)
        nearest = [hit_distances(Scene("one", (s,), scene.camera), rays) for s in scene.surfaces]
        first = np.argmin(nearest, axis=0)
        kinds = np.array([s.material.kind for s in scene.surfaces])[first]
        return {kind: float((kinds == kind).mean()) for kind in np.unique(kinds)}

    coated = [s.material for s in room("hall").surfaces if s.material.kind.startswith("rough")]
    assert min(m.roughness for m in coated) == 0.05 and max(m.roughness for m in coated) == 0.3
    assert shares(room("hall"))["roughplastic"] > 0.5
    found = shares(room("washroom"))
    assert found["roughplastic"] > 0.3 and found["thindielectric"] > 0.1 and found["conductor"] > 0.02
    kinds = {s.material.kind for s in room("washroom").surfaces}
    assert kinds == {"diffuse", "roughplastic", "conductor", "roughconductor", "thindielectric", "dielectric"}


def test_lamps_glow_inside_their_bulbs():
    by_name = {s.name: s for s in room("washroom").surfaces}
    for glass in ("thin glass", "thick glass"):
        glow, bulb = by_name[f"lamp in {glass}: glow"], by_name[f"lamp in {glass}: bulb"]
        centre = bulb.vertices.mean(axis=0)
        assert glow.emission > 0 and bulb.material.kind in ("dielectric", "thindielectric")
        radius = np.linalg.norm(bulb.vertices - centre, axis=1)
        assert np.linalg.norm(glow.vertices - centre, axis=1).max() < radius.min()
    # thick glass is a shell: the volume between its two spheres
    ball, shell = (volume(by_name[f"lamp in {glass}: bulb"]) for glass in ("thin glass", "thick glass"))
    assert shell / ball == pytest.approx(1 - (1 - washroom.GLASS_M / washroom.BULB_M) ** 3, rel=1e-6)


def test_turned_swept_and_sewn_bodies_are_closed():
    grey, bend = Material(), np.array(((0, 0, 0), (0, 1, 0), (0.5, 1.5, 0.2)))
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1)
    grid = np.concatenate((grid, np.zeros((3, 4, 1))), axis=-1)
    straight = rod(np.array(((0, 0, 0), (0, 0, 2))), 0.1, 64)
    for shape in (rod(bend, 0.1), cloth(grid, (0, 0, -0.1)), solid([(0, 0), (1, 0), (1, 2), (0, 2)], 64), straight):
        assert open_edges([joined("body", grey, shape)]) == 0
    inscribed = np.sin(2 * np.pi / 64) / (2 * np.pi / 64)  # of a circle's area
    assert volume(joined("rod", grey, straight)) == pytest.approx(2 * np.pi * 0.01 * inscribed)
    assert volume(joined("cloth", grey, cloth(grid, (0, 0, -0.1)))) == pytest.approx(0.6)
    assert creased([(0, 0), (1, 0), (1, 2), (0.9, 3)]) == [(0, 0), (1, 0), (1, 0), (1, 2), (0.9, 3)]
