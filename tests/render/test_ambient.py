"""Ambient light against Mitsuba's own path integrator, and its stated noise against repetitions."""

from dataclasses import replace

import numpy as np
import pytest

from render.ambient.allocation import numbers_for, relative_numbers
from render.ambient.bilateral_filter import bilateral_filter
from render.ambient.camera_paths import SETS
from render.ambient.integrator import ambient_light
from render.direct.integrator import Layers, centre_layers
from render.engine import render
from render.scene.traced_scene import TracedScene, mi
from render.settings import RenderSettings
from scene2spad.bench.hard import oracles
from scenes.geometry.shapes import box, sphere
from scenes.model import Ambient, Camera, Material, Scene, Surface

GLASS = Material("thindielectric", ior=1.5)


def windowed_room() -> Scene:
    """A closed room lit through a pane; a metal and a solid glass ball in it."""
    vertices, faces, uv = box((4, 3, 6))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=0.6), uv=uv)
    pane = oracles.quad([(-1, -0.8, -2.5), (1, -0.8, -2.5), (1, 0.8, -2.5), (-1, 0.8, -2.5)], GLASS)
    light = [(-0.8, -0.6, -2.8), (0.8, -0.6, -2.8), (0.8, 0.6, -2.8), (-0.8, 0.6, -2.8)]
    sky = Surface(np.array(light, float), [[0, 1, 2], [0, 2, 3]], Material(albedo=0.3), emission=1.0)
    balls = []
    for x, material in (
        (-1.0, Material("roughconductor", roughness=0.3, eta=2.9, k=3.1)),
        (1.0, Material("dielectric")),
    ):
        points, triangles, _ = sphere(0.4, 3)
        balls.append(Surface(points + (x, -0.6, -1.2), triangles, material, normals=points / 0.4))
    return Scene("windowed room", (walls, pane, sky, *balls), oracles.camera(8, 6, 70))


def mitsuba(world: TracedScene, spp: int, bounces: int, seed: int) -> float:
    """The image's mean by Mitsuba's path integrator, whose camera has x to the left and y up."""
    camera, turned = world.scene.camera, np.eye(4)
    turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    view = {"type": "perspective", "fov": camera.fov_deg, "fov_axis": "x", "near_clip": 1e-4}
    sensor = mi.load_dict(view | {"to_world": mi.ScalarTransform4f(turned), "film": film})
    integrator = mi.load_dict({"type": "path", "max_depth": bounces})
    return float(np.array(mi.render(world.mi_scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)).mean())


def test_light_through_panes_is_what_mitsuba_finds_by_chance():
    """The means of independent runs agree within 4 standard errors of their difference."""
    world = TracedScene(windowed_room())
    ours = np.array([ambient_light(world, 128, 30, seed).radiance.mean() for seed in range(8)])
    theirs = np.array([mitsuba(world, 1024, 30, seed) for seed in range(8)])
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert abs(ours.mean() - theirs.mean()) < 4 * error and error < 0.03 * ours.mean()


@pytest.mark.parametrize("pane", [False, True], ids=["all opaque", "beside glass"])
def test_ambient_light_is_the_same_at_every_scale(pane):
    """The sky comes in at the rim of a narrow gap alone, 0.05 mm high or 50 mm."""

    def gap(metres: float) -> np.ndarray:
        rows = [[(-1, y, -1), (1, y, -1), (1, y, 1), (-1, y, 1)] for y in (-0.05, 0.05)]
        faces = [oracles.quad(np.array(row) * metres, Material(albedo=0.3)) for row in rows]
        glass = oracles.quad(np.array([(2, 2, 2), (3, 2, 2), (3, 3, 2), (2, 3, 2)]) * metres, GLASS)
        camera = Camera.look_at((0, 0, 0), (0, -1, -2), fov_deg=30, width=6, height=4)
        scene = Scene("gap", (*faces, glass) if pane else tuple(faces), camera, ambient=Ambient(radiance=1))
        return ambient_light(TracedScene(scene), 256, 30, 1).radiance

    small, large = gap(0.5e-3), gap(0.5)
    assert small.mean() == pytest.approx(large.mean(), rel=0.02) and large.max() < 0.2


def test_the_stated_noise_is_that_of_repetitions():
    world = TracedScene(windowed_room())
    runs = [ambient_light(world, 32, 16, seed) for seed in range(12)]
    images = np.array([run.radiance for run in runs])
    spread = np.sqrt(images.var(axis=0, ddof=1).mean()) / images.mean()
    stated = np.sqrt(np.mean([run.error**2 for run in runs]))
    assert stated == pytest.approx(spread, rel=0.35) and stated > 0
    again = ambient_light(world, 32, 16, 0)
    assert (again.radiance == runs[0].radiance).all() and again.error == runs[0].error


def test_a_lamp_smaller_than_a_pixel_is_seen_evenly():
    """A glowing square as large as a third of a pixel: its light is the share of the image that it covers, and the
    noise falls faster than by one over the root of the number of paths, which would be 4 times here."""
    camera = oracles.camera(8, 6, 70)
    x, y, side = 0.31, -0.17, 0.21
    corners = [(x, y, -2.0), (x + side, y, -2.0), (x + side, y + side, -2.0), (x, y + side, -2.0)]
    lamp = Surface(np.array(corners), [[0, 1, 2], [0, 2, 3]], Material(albedo=0.0), emission=3.0)
    world = TracedScene(Scene("speck", (lamp,), camera))
    covered = (side / 2.0 * camera.focal_px) ** 2 / (camera.width * camera.height)
    few, many = ([ambient_light(world, spp, 4, seed) for seed in range(8)] for spp in (64, 1024))
    for runs in (few, many):
        means = np.array([run.radiance.mean(dtype=np.float64) for run in runs])
        error = means.std(ddof=1) / np.sqrt(len(means))
        assert abs(means.mean() - 3.0 * covered) < 5 * error and error < 0.1 * means.mean()
    ratio = np.mean([run.error**2 for run in few]) / np.mean([run.error**2 for run in many])
    assert ratio > 5**2


def test_paths_are_traced_until_the_noise_asked_for_and_no_further():
    """As good as that many at once; where the noise is out of reach, all that are allowed."""
    world = TracedScene(windowed_room())
    light = ambient_light(world, 4096, 16, 3, noise=0.05)
    assert 0.025 < light.error <= 0.05 and 64 < light.spp < 4096
    at_once = ambient_light(world, light.spp, 16, 3)
    apart = np.sqrt(np.square(light.radiance - at_once.radiance).mean()) / at_once.radiance.mean()
    assert at_once.error == pytest.approx(light.error, rel=0.3) and apart == pytest.approx(
        2**0.5 * light.error, rel=0.4
    )
    # uneven numbers come in steps of a path for each set
    assert 100 <= ambient_light(world, 100, 16, 3, noise=1e-6).spp < 108


def test_a_light_of_no_power_costs_no_noise():
    """Lights are chosen by their power: a speck that shines as brightly as the window is hardly ever tried."""
    room = windowed_room()
    speck = replace(room.surfaces[2], vertices=room.surfaces[2].vertices * 1e-3 + (0, -1.4, 0))
    noise = [
        np.mean([ambient_light(TracedScene(one), 64, 16, seed).error ** 2 for seed in range(4)])
        for one in (room, replace(room, surfaces=(*room.surfaces, speck)))
    ]
    assert noise[1] == pytest.approx(noise[0], rel=0.4)


def test_a_light_without_area_is_none():
    """Degenerate faces that emit: dark by themselves, and nothing beside a light from outside."""
    walls = windowed_room().surfaces[0]
    flat = Surface(np.full((3, 3), -1.0), [[0, 1, 2]], Material(albedo=0.5), emission=1.0)
    dark = Scene("degenerate light", (replace(walls, material=Material(albedo=0.4)), flat), oracles.camera(8, 6, 70))
    assert not ambient_light(TracedScene(dark), 4, 4, 1).radiance.any()
    lit = replace(dark, surfaces=(flat,), ambient=Ambient(radiance=0.1))
    assert np.allclose(ambient_light(TracedScene(lit), 4, 4, 1).radiance, 0.1)


def test_neighbours_share_irradiance_whatever_their_albedo_and_not_past_edges():
    """Light that an even irradiance would give stays; noise falls by the pixels that share; another wall is let be."""
    view = oracles.camera(32, 24, 60)
    board = (np.indices((24, 32)).sum(axis=0) % 2).astype(np.float16) * 0.6 + 0.2
    near = np.arange(32) < 16
    rays = view.rays()
    depth = np.where(near, 1.0, 2.0) / (rays @ view.rotation[:, 2])  # two frontal walls, one behind the other
    layers = Layers(depth, np.broadcast_to(-view.rotation[:, 2], (24, 32, 3)).astype(np.float16), board)
    albedo = board.astype(np.float32).astype(np.float64)
    even = albedo * np.where(near, 5.0, 1.0)
    assert np.allclose(bilateral_filter(even, layers, view), even, rtol=1e-5)
    noise = np.random.default_rng(1).normal(size=(64, 24, 32)) * albedo
    left = (bilateral_filter(noise, layers, view) / albedo)[:, 8:-8, 6:10].std()
    assert left < 0.25  # of about 4 pi sigma^2 pixels, of which the brighter half counts more
    nothing = layers._replace(depth_m=np.full((24, 32), np.nan))
    assert (bilateral_filter(even, nothing, view) == even).all()


def test_shared_light_keeps_what_is_seen_directly_and_its_mean():
    """Against the unshared light of the same room: the mean within 4 standard errors, the noise far below it."""
    room = windowed_room()
    world = TracedScene(replace(room, camera=room.camera.resized(32, 24)))
    layers = centre_layers(world)
    alone = [ambient_light(world, 16, 16, seed) for seed in range(6)]
    together = [ambient_light(world, 16, 16, 100 + seed, layers) for seed in range(6)]
    means = np.array([[run.radiance.mean() for run in runs] for runs in (alone, together)])
    spread = np.sqrt(means.var(axis=1, ddof=1).sum() / 6)
    assert abs(means[0].mean() - means[1].mean()) < 4 * spread + 0.02 * means[0].mean()
    before, images = (np.array([run.radiance for run in runs]) for runs in (alone, together))
    assert np.median(images.std(axis=0)) < 0.4 * np.median(before.std(axis=0))  # most pixels do not see the window
    left = np.sqrt(images.var(axis=0, ddof=1).mean()) / images.mean()
    assert np.sqrt(np.mean([run.error**2 for run in together])) == pytest.approx(left, rel=0.35)


def lit_by_a_mirror(*, image: bool) -> Scene:
    """A wall lit by a small lamp and a perfect mirror on the floor, or by the lamp and its image below it instead."""
    wall = oracles.quad([(-2, -1, -4), (2, -1, -4), (2, 1.5, -4), (-2, 1.5, -4)], Material(albedo=0.5))

    def lamp(y: float, faces: list[list[int]]) -> Surface:
        corners = [(-0.1, y, -2.6), (0.1, y, -2.6), (0.1, y, -2.4), (-0.1, y, -2.4)]
        return Surface(np.array(corners), faces, Material(albedo=0.0), emission=5.0)

    floor = np.array([(-2, -1, -4), (2, -1, -4), (2, -1, -1), (-2, -1, -1)], float)
    mirror = Surface(floor, [[0, 2, 1], [0, 3, 2]], Material("conductor", eta=0.0, k=1.0))
    other = lamp(-3.2, [[0, 2, 1], [0, 3, 2]]) if image else mirror
    return Scene("mirror", (wall, lamp(1.2, [[0, 1, 2], [0, 2, 3]]), other), oracles.camera(8, 6, 40))


def test_light_by_way_of_a_mirror_is_that_of_the_lamps_image():
    """Pixel by pixel, within 5 standard errors, where the camera sees the wall alone."""
    caustic, expected = (
        np.array(
            [ambient_light(TracedScene(lit_by_a_mirror(image=image)), 1024, 3, seed).radiance for seed in range(8)]
        )
        for image in (False, True)
    )
    caustic, expected = caustic[:, :5], expected[:, :5]  # the lowest row shows the mirror
    error = np.sqrt((caustic.var(axis=0, ddof=1) + expected.var(axis=0, ddof=1)) / 8)
    off = caustic.mean(axis=0) - expected.mean(axis=0)
    assert (expected.mean(axis=0) > 0).all() and (np.abs(off) < 5 * error).all()
    assert error.max() < 0.06 * expected.mean()


def test_a_lamp_in_thick_glass_is_what_mitsuba_finds_by_chance():
    """The means of independent runs agree within 4 standard errors."""
    vertices, faces, uv = box((4, 3, 6))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=0.6), uv=uv)
    points, triangles, _ = sphere(1.0, 3)
    at = np.array((0.3, 0.2, -2.0))
    outside, inside = (
        Surface(0.3 * size * points + at, turned, Material("dielectric"), normals=sign * points)
        for size, turned, sign in ((1.0, triangles, 1.0), (0.9, triangles[:, ::-1], -1.0))
    )
    lamp = Surface(0.1 * points + at, triangles, Material(albedo=0.3), normals=points, emission=2.0)
    world = TracedScene(Scene("bulb", (walls, outside, inside, lamp), oracles.camera(8, 6, 70)))
    ours = np.array([ambient_light(world, 1024, 16, seed).radiance.mean() for seed in range(8)])
    theirs = np.array([mitsuba(world, 2048, 16, seed) for seed in range(8)])
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert abs(ours.mean() - theirs.mean()) < 4 * error and error < 0.03 * ours.mean()


def test_paths_given_to_noisy_pixels_leave_the_mean_alone():
    """A lamp of a four hundredth of a pixel before a lit wall: the first paths often miss it, and given paths by their
    own light the image would be too dark. Closed form: the share of the image that the lamp covers."""
    camera, side = oracles.camera(8, 6, 70), 0.018
    corners = np.array([(0, 0, -2.0), (side, 0, -2.0), (side, side, -2.0), (0, side, -2.0)]) + (0.31, -0.17, 0)
    speck = Surface(corners, [[0, 1, 2], [0, 2, 3]], Material(albedo=0.0), emission=3.0)
    wall = oracles.quad([(-9, -9, -5), (9, -9, -5), (9, 9, -5), (-9, 9, -5)], Material(albedo=0.5))
    behind = np.array([(-1, -1, 1.0), (1, -1, 1.0), (1, 1, 1.0), (-1, 1, 1.0)])
    panel = Surface(behind, [[0, 2, 1], [0, 3, 2]], Material(albedo=0.0), emission=0.01)
    covered = (side / 2.0 * camera.focal_px) ** 2 / (camera.width * camera.height)
    assert 1 / 500 < covered * 48 < 1 / 300
    with_speck, without = (TracedScene(Scene("speck", one, camera)) for one in ((speck, wall, panel), (wall, panel)))
    plain = ambient_light(without, 4096, 2, 0).radiance.mean(dtype=np.float64)
    assert plain > 0
    runs = [ambient_light(with_speck, 512, 2, seed, noise=1e-6) for seed in range(96)]
    means = np.array([run.radiance.mean(dtype=np.float64) for run in runs]) - plain * (1 - covered)
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert abs(means.mean() - 3.0 * covered) < 4 * error and error < 0.15 * 3.0 * covered


def test_noisy_pixels_take_most_paths_and_none_decides_for_itself():
    shape, rng = (8, 6), np.random.default_rng(0)
    sums = rng.gamma(2.0, size=(SETS, 48))
    sums[:, 20] *= 100
    number = np.full(sums.shape, 8)
    relative = relative_numbers(sums, number, shape)
    assert relative.shape == (2, 48) and relative.mean() == pytest.approx(1, rel=1e-6)
    assert (relative.argmax(axis=1) == 20).all()
    sums[::2, 20] *= 10  # the first stream's light in that pixel
    again = relative_numbers(sums, number, shape)
    ratio = again / relative
    assert ratio[1, 20] > 3 * ratio[0, 20]  # the second stream takes more, the first only its share of the rest
    assert ratio[0, 20] < 1.01 * ratio[0, 47]
    present = np.full((2, 48), 32)
    numbers = numbers_for(100.0, relative, present, 4)
    assert (numbers >= present).all() and (numbers % 4 == 0).all() and 100 <= numbers.mean() < 108


@pytest.mark.parametrize("shared", [False, True])
def test_one_path_a_pixel_states_its_noise(shared):
    """2 are traced, whose difference tells it; halves of a filter hold one each. In 48 pixels, 8 tell it to 20 %."""
    world = TracedScene(windowed_room())
    layers = centre_layers(world) if shared else None
    one, eight = (ambient_light(world, spp, 4, 1, layers) for spp in (1, 8))
    assert one.spp == 2 and 0.5 * eight.error < one.error
    assert one.radiance.mean() == pytest.approx(eight.radiance.mean(), rel=4 * np.hypot(one.error, eight.error))


@pytest.mark.parametrize(("albedo", "left_out"), [(0.9, 0), (0.98, 0.98**256), (0.99, 0.99**256)])
def test_light_between_white_walls_is_all_there_or_stated(albedo: float, left_out: float):
    """In a closed box whose walls emit 1 and reflect albedo a, every pixel sees 1 / (1 - a)."""
    vertices, faces, uv = box((4, 4, 4))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=albedo), uv=uv, emission=1.0)
    scene = Scene("furnace", (walls,), oracles.camera(16, 12, 60))
    transient = render(scene, RenderSettings(bounces=1, ambient_spp=256))
    assert transient.ambient.mean() * (1 - albedo) == pytest.approx(1 - left_out, abs=0.02)
    noise = transient.ambient.std() / transient.ambient.mean()
    assert transient.meta["ambient_error"] == pytest.approx(np.hypot(noise, left_out), rel=0.3)
    said = any("left out beyond 256 surfaces" in line for line in transient.meta["plan"]["reasons"])
    assert said == (left_out > 1e-3)
