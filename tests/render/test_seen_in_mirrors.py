"""Check what a laser lights directly and mirrors show: it is traced cell by cell, not met by chance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from render import RenderSettings, render
from render.scene.traced_scene import TracedScene
from render.specular.image_method import specular_light
from render.specular.image_sequences import image_sequences
from render.specular.mirrors import MAX_ORDER, find_mirrors
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere

MIRROR = Material("conductor", eta=0.0, k=1.0, specular=0.8)
WALL = Material(albedo=0.5)


def quad(corners: list, material: Material) -> Surface:
    return Surface(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], material)


def view(width: int = 17, height: int = 13, fov_deg: float = 20.0) -> Camera:
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def by_pixel(scene: Scene, samples, kept) -> np.ndarray:
    pixels = scene.camera.width * scene.camera.height
    return np.bincount(samples.pixel[kept], samples.radiance[kept].astype(float), pixels)


def shown_wall(laser: Laser) -> Scene:
    """A mirror at 45 degrees before the camera shows a wall at x = 3, which the laser lights directly, too."""
    mirror = quad([(-2, -3, 0), (2, -3, -4), (2, 3, -4), (-2, 3, 0)], MIRROR)
    wall = quad([(3, -9, 9), (3, -9, -9), (3, 9, -9), (3, 9, 9)], WALL)
    return Scene("shown wall", (mirror, wall), view(), laser)


@pytest.mark.parametrize("baseline_m", [(0, 0, 0), (0.4, -0.2, 0)])
def test_a_wall_seen_in_a_mirror_and_lit_directly(baseline_m):
    """R albedo / pi I cos / d^2 at path |unfolded| + d, by 40 x 40 rays a pixel."""
    scene = shown_wall(Laser("flood", baseline_m, cone_deg=360.0))
    side, camera = 40, scene.camera
    column, row = np.meshgrid((np.arange(17 * side) + 0.5) / side, (np.arange(13 * side) + 0.5) / side)
    rays = camera.rays(column.ravel(), row.ravel())
    point = rays * (5 / -rays[:, 2:])  # the wall's image is at z = -5
    unfolded_m = np.linalg.norm(point, axis=1)
    lit = np.column_stack((-(point[:, 2] + 2), point[:, 1], -point[:, 0] - 2))
    to_laser = scene.laser.position(camera) - lit
    leg_m = np.linalg.norm(to_laser, axis=1)
    light = 0.8 * 0.5 / math.pi * scene.laser.intensity(camera).mean() * -to_laser[:, 0] / leg_m**3
    pixel = row.ravel().astype(int) * 17 + column.ravel().astype(int)
    want = np.bincount(pixel, light) / side**2
    path_m = np.bincount(pixel, light * (unfolded_m + leg_m)) / side**2 / want
    found = specular_light(TracedScene(scene), 4).samples
    once = found.bounces == 2
    got = by_pixel(scene, found, once)
    assert got == pytest.approx(want, rel=1e-3)
    moment = found.radiance[once].astype(float) * found.path_m[once]
    assert np.bincount(found.pixel[once], moment) / got == pytest.approx(path_m, abs=1e-3)


def test_paths_leave_out_what_is_traced_by_mirrors():
    """All light of two surfaces in a mirror is there without noise, and once."""
    scene = shown_wall(Laser("flood", cone_deg=360.0))
    whole = render(scene, RenderSettings(bounces=2, grid=4, spp=16, ambient=False))
    alone = specular_light(TracedScene(scene), 4, bounces=2).samples
    assert whole.radiance.sum(dtype=float) == pytest.approx(alone.radiance.sum(dtype=float), rel=1e-5)
    assert not whole.error.any()


def test_a_wall_seen_in_a_ball():
    """A ball of smooth metal shows a wall beside the camera: R albedo / pi I cos / d^2, by 24 x 24 rays a pixel."""
    radius, centre, wall_x, camera = 0.5, np.array((0.0, 0.0, -3.0)), -2.0, view(24, 24, 18.0)
    points, faces, _ = sphere(radius, 6)
    ball = Surface(points + centre, faces, MIRROR, normals=points / radius)
    wall = quad([(wall_x, -40, 40), (wall_x, 40, 40), (wall_x, 40, -40), (wall_x, -40, -40)], WALL)
    scene = Scene("ball", (ball, wall), camera, Laser("flood", (0.3, 0.4, 0), cone_deg=360.0))
    side = 24
    column, row = np.meshgrid(*[(np.arange(24 * side) + 0.5) / side] * 2)
    rays = camera.rays(column.ravel(), row.ravel())
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = rays @ centre
    off = along**2 - centre @ centre + radius**2
    hits = off > 0
    met = rays * (along - np.sqrt(np.maximum(off, 0)))[:, None]
    normal = (met - centre) / radius
    onward = rays - 2 * (rays * normal).sum(axis=1, keepdims=True) * normal
    way = (wall_x - met[:, 0]) / np.minimum(onward[:, 0], -1e-9)
    lit = met + way[:, None] * onward
    to_laser = scene.laser.position(camera) - lit
    leg = np.linalg.norm(to_laser, axis=1)
    light = 0.8 * 0.5 / math.pi * scene.laser.intensity(camera).mean() * to_laser[:, 0] / leg**3
    from_laser = -to_laser / leg[:, None]  # the ball's shadow on the wall
    nearest = ((centre - scene.laser.position(camera)) * from_laser).sum(axis=1)
    shadow = np.linalg.norm(scene.laser.position(camera) + nearest[:, None] * from_laser - centre, axis=1) < radius
    light[~hits | (onward[:, 0] >= -1e-9) | (np.abs(lit[:, 1:]) > 40).any(axis=1) | (shadow & (nearest < leg))] = 0
    pixel = row.ravel().astype(int) * 24 + column.ravel().astype(int)
    want = np.bincount(pixel, light) / side**2
    found = specular_light(TracedScene(scene), 8, allowed=(1e-3, 0.0)).samples
    got = by_pixel(scene, found, found.bounces == 2)
    assert got.sum() == pytest.approx(want.sum(), rel=2e-3)
    assert np.linalg.norm(got - want) < 0.01 * np.linalg.norm(want)


@pytest.mark.parametrize("bounces", [4, 5, 8])
def test_a_corridor_of_mirrors_has_each_number_of_mirrors_once(bounces):
    """Two mirrors face each other: a pixel that meets n of them sees the spot on the far wall with R^n. Up to MAX_ORDER
    of them are traced, more are met by paths; none is there twice or missing."""
    half_m, far_m, cone_deg, camera = 0.5, 8.0, 7.0, view(32, 2, 80.0)  # the spot ends beside the mirrors
    sides = [quad([(x, -9, 1), (x, -9, -far_m), (x, 9, -far_m), (x, 9, 1)], MIRROR) for x in (-half_m, half_m)]
    wall = quad([(-half_m, -9, -far_m), (half_m, -9, -far_m), (half_m, 9, -far_m), (-half_m, 9, -far_m)], WALL)
    scene = Scene("corridor", (*sides, wall), camera, Laser("flood", cone_deg=cone_deg))
    side = 64
    column, row = np.meshgrid((np.arange(32 * side) + 0.5) / side, (np.arange(2 * side) + 0.5) / side)
    rays = camera.rays(column.ravel(), row.ravel())
    point = rays * (far_m / -rays[:, 2:])
    met = np.floor(np.abs(point[:, 0]) / (2 * half_m) + 0.5).astype(int)
    folded = point[:, 0] - np.sign(point[:, 0]) * met * 2 * half_m
    aside_m = np.hypot(folded, point[:, 1])
    light = 0.8**met * 0.5 / math.pi * scene.laser.intensity(camera).mean() * far_m / np.hypot(aside_m, far_m) ** 3
    light[(met == 0) | (met + 1 > bounces) | (aside_m > far_m * math.tan(math.radians(cone_deg / 2)))] = 0
    pixel = row.ravel().astype(int) * 32 + column.ravel().astype(int)
    want = np.bincount(pixel, light) / side**2
    found = render(scene, RenderSettings(bounces=bounces, grid=16, spp=1024, ambient=False), seed=1)
    late = found.bounces > 1
    got = np.bincount(found.return_pixel[late], found.radiance[late].astype(float), len(want))
    assert met.max() > MAX_ORDER and np.abs(got - want).max() < 0.06 * want.max()
    assert got.sum() == pytest.approx(want.sum(), rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_a_highlight_in_a_mirror_does_not_hang_on_chance(seed):
    """A chrome ball whose highlight is far smaller than a pixel: each render has it, against 160 x 160 cells; paths
    found it in one of several."""
    vertices, faces, _ = sphere(0.05, 5)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    chrome = Material("roughconductor", roughness=0.02, eta=2.9, k=3.1)
    mirror = quad([(-2, -3, 0), (2, -3, -4), (2, 3, -4), (-2, 3, 0)], MIRROR)
    ball = Surface(vertices + (2, 0, -2), faces, chrome, normals=normals)
    scene = Scene("ball in a mirror", (mirror, ball), view(), Laser("flood", cone_deg=360.0))
    fine = specular_light(TracedScene(scene), 160, bounces=2).samples
    want = by_pixel(scene, fine, fine.bounces == 2)
    found = render(scene, RenderSettings(bounces=2, grid=3, spp=4, ambient=False), seed=seed)
    got = np.bincount(found.return_pixel, found.radiance.astype(float), len(want))
    assert np.linalg.norm(got - want) < 0.02 * np.linalg.norm(want)


@pytest.mark.parametrize("mode", ["flood", "line", "scan"])
def test_a_needle_between_cells_is_found_by_what_its_neighbours_show(mode):
    """A chrome needle of a fifth of a pixel, seen in a mirror by 3 cells a side, against 160."""
    points, faces, _ = sphere(1.0, 5)
    size = np.array((0.008, 0.4, 0.008))
    turn = np.array([(1, 0, 0), (0, math.cos(0.3), math.sin(0.3)), (0, -math.sin(0.3), math.cos(0.3))])
    normals = points / size / np.linalg.norm(points / size, axis=1, keepdims=True)
    chrome = Material("roughconductor", roughness=0.05, eta=2.9, k=3.1)
    needle = Surface((points * size) @ turn.T + (2, 0, -2), faces, chrome, normals=normals @ turn.T)
    mirror = quad([(-2, -3, 0), (2, -3, -4), (2, 3, -4), (-2, 3, 0)], MIRROR)
    laser = Laser("flood", cone_deg=360.0) if mode == "flood" else Laser(mode)
    world = TracedScene(Scene("needle", (mirror, needle), view(), laser))
    fine, found = (specular_light(world, side, allowed=(a, 0.0)).samples for side, a in ((160, 0.0), (3, 1e-3)))
    want, got = (by_pixel(world.scene, one, one.bounces > 1) for one in (fine, found))
    assert np.linalg.norm(got - want) < 0.02 * np.linalg.norm(want) and want.any()


def ways(surfaces: tuple, laser: Laser) -> tuple[list, list[str]]:
    """Return the sequences of mirrors that light of a laser takes, and the notes."""
    world = TracedScene(Scene("ways", surfaces, view(), laser))
    mirrors, notes = find_mirrors(world)
    return image_sequences(world, mirrors, notes), notes


def test_a_mirror_lights_no_mirror_behind_it():
    """Find three lit sides of a box, none of which lights another; a plane before it and the side that faces it light
    each other, up to MAX_ORDER times."""
    vertices, faces, uv = box((1.0, 1.0, 0.1))
    body = Surface(vertices + (0, 0, -3), faces, MIRROR, uv=uv)
    before = quad([(-0.4, -0.4, 1), (0.4, -0.4, 1), (0.4, 0.4, 1), (-0.4, 0.4, 1)], MIRROR)
    laser = Laser("flood", (0.6, 0.6, 0), 360.0)
    assert [len(row) for row in ways((body,), laser)[0]] == [1, 1, 1]
    rows, _ = ways((body, before), laser)
    assert [len(row) for row in rows].count(1) == 4 and {len(row) for row in rows} <= {1, 2, 3}
    facing = [row for row in rows if len(row) == 2]
    assert len(facing) == 2 and set(facing[0]) == set(facing[1]) and (facing[0] == facing[1][::-1]).all()


def test_light_of_a_laser_inside_a_box_of_mirrors_goes_by_all_ways():
    """A corner's three sides light each other in any order, and opposite sides do."""
    vertices, faces, uv = box((2.0, 2.0, 2.0))
    for wound in (faces, faces[:, ::-1]):
        rows, notes = ways((Surface(vertices, wound, MIRROR, uv=uv),), Laser("flood", (0.1, 0.2, 0.3), 360.0))
        lengths = [len(row) for row in rows]
        assert lengths.count(1) == 6 and lengths.count(2) == 30
        assert len(rows) == 64 and any("ways by mirrors are left out" in note for note in notes)


def test_sequences_are_in_order_from_what_they_light_to_the_laser():
    """The laser shines on the first mirror alone, which shows it to the second."""
    first = quad([(-1, -1, -3), (1, -1, -3), (1, 1, -3), (-1, 1, -3)], MIRROR)
    second = quad([(-4, -4, 2), (4, -4, 2), (4, 4, 2), (-4, 4, 2)], MIRROR)
    shade = quad([(-4, -4, 1.9), (-1.2, -4, 1.9), (-1.2, 4, 1.9), (-4, 4, 1.9)], WALL)
    world = TracedScene(Scene("order", (first, second, shade), view(), Laser()))
    mirrors, notes = find_mirrors(world)
    rows = [tuple(mirrors.offset[row]) for row in image_sequences(world, mirrors, notes) if len(row) == 2]
    assert {tuple(np.abs(row)) for row in rows} == {(2.0, 3.0), (3.0, 2.0)}


def test_of_very_many_mirrors_those_that_most_light_meets_light_others():
    centres = [(x, y, -5.0) for x in np.linspace(-2, 2, 12) for y in np.linspace(-2, 2, 12)]
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    tilted = square @ np.array([(1, 0, 0.3), (0, 1, 0.2), (0, 0, 1)])
    surfaces = tuple(quad(list(tilted * 0.1 + centre + (0, 0, 0.01 * k)), MIRROR) for k, centre in enumerate(centres))
    rows, notes = ways(surfaces, Laser("flood", cone_deg=360.0))
    assert len(rows) == 64 and any("of 144 ways by mirrors are left out" in note for note in notes)


def test_of_hundreds_of_mirrors_single_ones_light_others():
    """Leave out ways over two mirrors, and say so, where there are more planes than are looked through."""
    vertices, faces, uv = box((0.1, 0.1, 0.1))
    centres = [(x, y, -5.0) for x in np.linspace(-2, 2, 8) for y in np.linspace(-2, 2, 8)]
    apart = np.array((0.001, 0.002, 0.01))
    surfaces = tuple(Surface(vertices + centre + k * apart, faces, MIRROR, uv=uv) for k, centre in enumerate(centres))
    rows, notes = ways(surfaces, Laser("flood", cone_deg=360.0))
    assert {len(row) for row in rows} == {1}
    assert any("ways by two or more of" in note and "the limit is 256" in note for note in notes)


def test_degenerate_and_hidden_mirrors_light_nothing():
    flat = Surface(np.zeros((3, 3)) + (0, 0, -2), [[0, 1, 2]], MIRROR)
    assert ways((flat, quad([(-1, -1, -3), (1, -1, -3), (1, 1, -3), (-1, 1, -3)], WALL)), Laser())[0] == []
    hidden = quad([(-1, -1, -4), (1, -1, -4), (1, 1, -4), (-1, 1, -4)], MIRROR)
    front = quad([(-9, -9, -3), (9, -9, -3), (9, 9, -3), (-9, 9, -3)], WALL)
    assert ways((front, hidden), Laser("flood", cone_deg=360.0))[0] == []
