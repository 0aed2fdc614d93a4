"""The renderer against closed forms, float64 quadratures of the same geometry and Mitsuba's steady render."""

from functools import partial

import numpy as np
import pytest

from render.engine import render
from render.error import response
from render.indirect.integrator import IndirectTask, indirect_light, path_grid
from render.indirect.launch_layout import block_order
from render.indirect.schedule import uniform
from render.scene.traced_scene import TracedScene
from render.settings import RenderSettings
from render.transient import Transient
from render.transient.samples import SampleBuffer, Samples
from scene2spad.bench.hard import oracles
from scenes import Ambient, Camera, Laser, Material, Scene, Surface, Texture
from scenes.geometry.shapes import box, sphere

DIRECT = RenderSettings(bounces=1, grid=4, direct_tolerance_m=1e-4)


def path_deviation(transient: Transient) -> np.ndarray:
    """Standard deviation of each pixel's path lengths, footprints included."""
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    mean = transient.mean_path_m().ravel()[transient.return_pixel]
    second = transient.radiance * ((0.5 * (near + far) - mean) ** 2 + (far - near) ** 2 / 12)
    total = transient.total_radiance()
    moment = np.bincount(transient.return_pixel, weights=second, minlength=total.size).reshape(total.shape)
    return np.sqrt(moment / total)


@pytest.mark.parametrize("distance_m", [0.3, 1.0, 3.0, 14.0])
def test_frontal_plane(distance_m):
    scene = Scene("plane", (oracles.wall(distance_m, 0.5, half_size_m=20),), oracles.camera())
    transient = render(scene, DIRECT)
    total, mean, _ = oracles.plane_moments(scene, distance_m=distance_m, tilt_deg=0, albedo=0.5)
    assert np.abs(transient.total_radiance() / total - 1).max() < 1e-4
    assert np.abs(transient.mean_path_m() - mean).max() < 1e-4
    # the optical axis meets the corner of four pixels: the first light of all comes from there
    assert abs(transient.path_near_m.min() - 2 * distance_m) < 1e-4
    centre = 1 / np.linalg.norm(scene.camera.rays() @ np.array([[0], [0], [-1.0]]), axis=-1)
    assert np.abs(transient.depth_m - distance_m * centre).max() < 2e-6 * distance_m
    assert not transient.mixed.any() and np.allclose(transient.normal, [0, 0, 1]) and np.allclose(transient.albedo, 0.5)


def test_frontal_plane_follows_the_inverse_square_law():
    distances = np.array([0.3, 1.0, 3.0, 14.0])
    scenes = [Scene("p", (oracles.wall(d, 0.5, half_size_m=20),), oracles.camera()) for d in distances]
    totals = np.array([render(scene, DIRECT).total_radiance().sum() for scene in scenes])
    assert np.ptp(totals * distances**2) / np.mean(totals * distances**2) < 1e-6


@pytest.mark.parametrize("tilt_deg", [20, 45, 65])
@pytest.mark.parametrize("mode", ["flood", "line", "scan"])
def test_oblique_plane(tilt_deg, mode):
    surface = oracles.wall(3.0, 0.8, tilt_deg=tilt_deg, half_size_m=60)
    scene = Scene("oblique", (surface,), oracles.camera(), Laser(mode))
    transient = render(scene, RenderSettings(bounces=1, grid=8, direct_tolerance_m=1e-4))
    total, mean, deviation = oracles.plane_moments(scene, distance_m=3.0, tilt_deg=tilt_deg, albedo=0.8, per_side=12)
    assert np.abs(transient.total_radiance() / total - 1).max() < 1e-4
    # a pixel at 82 degrees of incidence spans 1.8 m of path
    assert (np.abs(transient.mean_path_m() - mean) < 1e-4 + 1e-3 * deviation).all()
    assert np.abs(path_deviation(transient) / deviation - 1).max() < 2e-3
    assert not transient.mixed.any()


def test_sphere_of_subdivision_seven():
    vertices, faces, _ = sphere(0.5, 7)
    surface = Surface(vertices + [0, 0, -3], faces, Material(albedo=0.7))
    scene = Scene("sphere", (surface,), oracles.camera(48, 36, 30))
    transient = render(scene, RenderSettings(bounces=1, grid=16, direct_tolerance_m=1e-4))
    total, mean, _ = oracles.sphere_moments(
        scene, distance_m=3.0, radius_m=0.5, reflected=partial(oracles.paint, albedo=0.7), per_side=64
    )
    got = transient.total_radiance()
    assert abs(got.sum() / total.sum() - 1) < 1e-4
    both = (total > 0) & (got > 0) & ~transient.mixed
    error = np.abs(transient.mean_path_m() - mean)[both]
    assert error.max() < 2e-4


def test_first_interreflection_of_a_groove():
    albedo, edges = 0.6, np.linspace(5.0, 7.5, 51)
    scene = oracles.groove_scene(16, 12, albedo=albedo)
    expected = oracles.groove_interreflection(scene, albedo=albedo, edges_m=edges)
    settings = RenderSettings(bounces=2, spp=1 << 16, grid=2, indirect_tolerance_m=1e-3, indirect_growth=0)
    transient = render(scene, settings, seed=1)
    second = transient.bounces == 2
    centre = 0.5 * (transient.path_near_m + transient.path_far_m)[second]
    got = np.histogram(centre, bins=edges, weights=transient.radiance[second])[0] / (16 * 12)
    assert abs(got.sum() / expected.sum() - 1) < 5e-3
    assert np.linalg.norm(got - expected) / np.linalg.norm(expected) < 1e-2


@pytest.mark.slow
def test_more_paths_of_a_block_are_one_low_discrepancy_set():
    """Sixteen times the paths of blocks that share lower the squared error more than 16 times, and do not move the
    mean. (15 times where every sample has a set of its own.)"""
    world, pixels = TracedScene(oracles.groove_scene(16, 12, albedo=0.6)), np.arange(16 * 12)
    blocks, grid = block_order(pixels, 16), path_grid(world, np.full(16 * 12, 5.0), 1.0, 2, 0.01, 0.0)
    found = []
    for spp in (16, 256):
        images = []
        for seed in range(10):
            light = SampleBuffer()
            indirect_light(
                IndirectTask(world, uniform(blocks, spp, reuses_paths=True), 2, seed, grid), pixels[:0], light.add
            )
            images.append(response(light.finished(), pixels))
        energy = np.sum(images, axis=(1, 2))
        found.append((np.var(images, axis=0, ddof=1).sum(), energy.mean(), energy.var(ddof=1) / len(energy)))
    (few, mean_few, off_few), (many, mean_many, off_many) = found
    # 12 blocks and 9 degrees of freedom: each variance is known to 14 %
    assert few / many > 1.3 * 16
    assert abs(mean_few - mean_many) < 4 * np.sqrt(off_few + off_many)


def test_stated_noise_is_that_of_different_seeds():
    """Four batches of a low-discrepancy set each state the noise that renders of other seeds have."""
    scene, pixels = oracles.groove_scene(16, 12, albedo=0.6), np.arange(16 * 12)
    found = [render(scene, RenderSettings(bounces=2, spp=64, grid=2), seed=seed) for seed in range(8)]
    images = np.array([response(samples_of(transient), pixels) for transient in found])
    squared = images.var(axis=0, ddof=1).sum() / (images.mean(axis=0) ** 2).sum()
    stated = np.mean([transient.meta["relative_error"]["monte_carlo"] ** 2 for transient in found])
    # 12 blocks: 3 degrees of freedom in each of 8 renders, and 7 between these: 8 and 15 % of the squares
    assert 1 / 1.3 < np.sqrt(stated / squared) < 1.3


def samples_of(transient: Transient) -> Samples:
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    return Samples(transient.return_pixel, (near + far) / 2, (far - near) / 2, transient.radiance, transient.bounces)


def diffuse_room(laser: Laser) -> Scene:
    """A closed box with a ball, a plastic table top and a tilted panel: something for every kind of reflection."""
    vertices, faces, uv = box((4, 3, 5))
    room = Surface(vertices + [0, 0, -1.5], faces[:, ::-1], Material(albedo=0.6), uv=uv, name="room")
    checker = Texture(np.kron([[0.2, 0.9], [0.9, 0.2]], np.ones((4, 4))), "checker")
    table = Material("roughplastic", albedo=checker, roughness=0.3, name="table")
    corners = [(-1, -0.6, -1.5), (1, -0.6, -1.5), (1, -0.6, -3), (-1, -0.6, -3)]
    top = Surface(
        np.array(corners, float), [[0, 1, 2], [0, 2, 3]], table, uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    )
    vertices, faces, _ = sphere(0.4, 4)
    ball = Surface(vertices + [0.5, -0.1, -2.2], faces, Material("roughconductor", roughness=0.4, eta=1.5, k=6.0))
    return Scene("box", (room, top, ball), oracles.camera(24, 18, 60), laser)


@pytest.mark.parametrize("bounces", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_energy_equals_mitsuba_steady_render(bounces):
    """Summed over time, laser light is what Mitsuba's path tracer gives for a point light of intensity 1/(4 pi)."""
    scene = diffuse_room(Laser("flood", cone_deg=360))
    transient = render(scene, RenderSettings(bounces=bounces, spp=4096, grid=64), seed=3)
    ours, our_error = transient.total_radiance(), transient.error.astype(float)
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 1 / (4 * np.pi)}}
    runs = np.array([steady_by_mitsuba(scene, lamp, max_depth=bounces + 1, spp=1024, seed=seed) for seed in range(16)])
    theirs, their_error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / 4
    # the image mean: 16 runs give Student's t with 15 degrees of freedom, 4.1 is the two-sided 0.1 % point
    error = np.hypot(np.sqrt((our_error**2).sum()), runs.sum(axis=(1, 2)).std(ddof=1) / 4)
    assert abs(ours.sum() - theirs.sum()) < 4.1 * error + 2e-4 * theirs.sum()
    # every pixel, Sidak-corrected over 432 pixels; on an edge a 64 x 64 grid knows the coverage to 1/128
    z = np.abs(ours - theirs) / np.hypot(np.hypot(our_error, their_error), 4e-3 * theirs)
    assert (z < 7.0).all()


def steady_by_mitsuba(scene: Scene, light: dict, *, max_depth: int, spp: int, seed: int) -> np.ndarray:
    from render.scene.traced_scene import TracedScene, mi

    objects = {f"shape{i}": shape for i, shape in enumerate(TracedScene(scene).mi_scene.shapes())}
    traced = mi.load_dict({"type": "scene", "light": light, **objects})
    view = scene.camera
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": view.fov_deg,
            "to_world": mi.ScalarTransform4f(view.pose @ np.diag([-1.0, -1, 1, 1])),
            "film": {"type": "hdrfilm", "width": view.width, "height": view.height, "rfilter": {"type": "box"}},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 100})
    return np.array(mi.render(traced, sensor=sensor, integrator=integrator, spp=spp, seed=seed))[..., 0].astype(float)


def test_flood_light_ends_at_its_cone():
    scene = Scene(
        "plane", (oracles.wall(2.0, 0.5, half_size_m=20),), oracles.camera(32, 24, 60), Laser("flood", cone_deg=30)
    )
    lit = render(scene, DIRECT).total_radiance() > 0
    cosine = -scene.camera.rays()[..., 2]
    margin = 2 / scene.camera.focal_px
    assert (
        lit[cosine > np.cos(np.radians(15) - margin)].all() and not lit[cosine < np.cos(np.radians(15) + margin)].any()
    )


def test_window_dims_the_wall_behind_it_and_delays_it():
    """A thin pane dims by ((1 - F) / (1 + F))^2; a slab of thickness t by (1 - F)^4, and adds 2 t (n - 1) of path."""
    fresnel = (0.5 / 2.5) ** 2
    wall, view = oracles.wall(3.0, 0.5, half_size_m=20), oracles.camera(8, 6, 2.0)
    bare = render(Scene("bare", (wall,), view), DIRECT)
    pane = oracles.quad([(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)], Material("thindielectric", ior=1.5))
    seen = render(Scene("pane", (wall, pane), view), DIRECT)
    aside = np.ones((6, 8), bool)
    aside[2:4, 3:5] = False  # the pixels that hold the pane's own return
    dimmed = seen.total_radiance() / bare.total_radiance()
    assert np.allclose(dimmed[aside], ((1 - fresnel) / (1 + fresnel)) ** 2, rtol=1e-3)
    assert np.allclose(seen.depth_m, bare.depth_m)
    vertices, faces, uv = box((2, 2, 0.3))
    slab = Surface(vertices + [0, 0, -1], faces, Material("dielectric", ior=1.5), uv=uv)
    seen = render(Scene("slab", (wall, slab), view), DIRECT)
    spreading = (3 / 2.9) ** 2  # the slab brings the wall 0.3 (1 - 1 / 1.5) = 0.1 m nearer to the laser
    dimmed = seen.total_radiance() / bare.total_radiance()
    assert np.allclose(dimmed[aside], (1 - fresnel) ** 4 * spreading, rtol=1e-3)
    assert np.allclose((seen.mean_path_m() - bare.mean_path_m())[aside], 2 * 0.3 * 0.5, atol=2e-4)
    assert np.allclose(seen.depth_m, bare.depth_m, atol=1e-5)
    inside_out = Surface(slab.vertices, faces[:, ::-1], slab.material, uv=uv)
    turned = render(Scene("in", (wall, inside_out), view), DIRECT).mean_path_m()
    assert np.allclose(turned[aside], seen.mean_path_m()[aside], atol=1e-5)


def test_wall_inside_glass_is_reached_through_it():
    """Glass from 2 to 4 m with a wall in it at 3 m: 2 m of air, 1 m of glass, and back."""
    vertices, faces, uv = box((4, 4, 2))
    block = Surface(vertices + [0, 0, -3], faces, Material("dielectric", ior=1.5), uv=uv)
    for baseline in ((0, 0, 0), (0.01, 0, 0)):
        laser = Laser("flood", baseline, 30.0)
        scene = Scene("block", (oracles.wall(3.0, 0.5), block), oracles.camera(8, 6, 2.0), laser)
        aside = np.ones((6, 8), bool)
        aside[2:4, 3:5] = False  # the pixels that hold the glass's own return
        assert np.allclose(render(scene, DIRECT).mean_path_m()[aside], 2 * (2 + 1.5), atol=2e-3)


def test_glass_elsewhere_changes_no_path():
    """A pane behind the camera switches the slow tracer on; a displaced laser's path must stay what it was."""
    laser, wall = Laser("flood", (0.2, 0, 0), 100.0), oracles.wall(10.0, 0.5, half_size_m=40)
    pane = oracles.quad([(-1, -1, 3), (1, -1, 3), (1, 1, 3), (-1, 1, 3)], Material("thindielectric"))
    plain = render(Scene("plain", (wall,), oracles.camera(), laser), DIRECT)
    glazed = render(Scene("glazed", (wall, pane), oracles.camera(), laser), DIRECT)
    assert np.abs(glazed.mean_path_m() - plain.mean_path_m()).max() < 2e-5


@pytest.mark.parametrize("cone_deg", [0.5, 2, 20])
def test_narrow_cones_carry_one_joule(cone_deg):
    """Irradiance over a frontal wall, pi L / albedo, integrates to the laser's energy: what leaves arrives."""
    scene = Scene(
        "beam",
        (oracles.wall(5.0, 0.5, half_size_m=5),),
        oracles.camera(64, 64, 1.5 * cone_deg),
        Laser("flood", cone_deg=cone_deg),
    )
    radiance = render(scene, RenderSettings(bounces=1, grid=16)).total_radiance()
    pixel_area = (5.0 / scene.camera.focal_px) ** 2
    assert (np.pi / 0.5 * radiance * pixel_area).sum() == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("shift_m", [0, 1000.0])
def test_a_scene_far_from_the_origin_is_the_same_scene(shift_m):
    scene = diffuse_room(Laser("flood", cone_deg=360))
    moved = Scene("moved", tuple(Surface(s.vertices + shift_m, s.faces, s.material, s.uv) for s in scene.surfaces),
                  Camera.look_at((shift_m,) * 3, (shift_m, shift_m, shift_m - 1), fov_deg=60, width=24, height=18),
                  scene.laser)  # fmt: skip
    settings = RenderSettings(bounces=3, spp=256, grid=4)
    here, there = render(scene, settings), render(moved, settings)
    assert np.nanmax(np.abs(here.depth_m - there.depth_m)) < 1e-5
    later, later_there = here.bounces > 1, there.bounces > 1
    mean = [np.average(t.path_near_m[k] + t.path_far_m[k], weights=t.radiance[k]) / 2
            for t, k in ((here, later), (there, later_there))]  # fmt: skip
    assert abs(mean[0] - mean[1]) < 1e-3


def test_line_laser_keeps_its_indirect_light():
    transient = render(diffuse_room(Laser("line")))
    assert transient.meta["plan"]["bounces"] > 1 and 0.01 < transient.indirect_fraction < 0.3


def test_ambient_light_passes_the_holes_of_a_cutout():
    sheet = oracles.quad([(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)], Material(albedo=0.0, opacity=0.0))
    scene = Scene("sheet", (oracles.wall(2, 1.0, half_size_m=9), sheet), oracles.camera(8, 6, 40), ambient=Ambient(1.0))
    assert render(scene, RenderSettings(bounces=1)).ambient.mean() == pytest.approx(1.0, abs=0.02)


def test_cutout_shows_what_lies_behind_its_holes():
    holes = Texture(np.kron([[0, 1], [1, 0]], np.ones((32, 32))), "holes")
    corners = np.array([(-2, -2, -2), (2, -2, -2), (2, 2, -2), (-2, 2, -2)], float)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    leaf = Surface(corners, [[0, 1, 2], [0, 2, 3]], Material(albedo=0.5, opacity=holes), uv=uv)
    scene = Scene("leaf", (oracles.wall(3.0, 0.5, half_size_m=20), leaf), oracles.camera(16, 12, 20))
    depth = render(scene, DIRECT).depth_m * -scene.camera.rays()[..., 2]
    # the image's first row is on top: holes lie to the left above and to the right below
    expected = np.where((np.arange(12)[:, None] < 6) == (np.arange(16)[None, :] < 8), 3.0, 2.0)
    assert np.allclose(depth[1:5, 1:7], expected[1:5, 1:7], atol=1e-4)
    assert np.allclose(depth[7:11, 1:7], expected[7:11, 1:7], atol=1e-4)
    assert np.allclose(depth[7:11, 9:15], expected[7:11, 9:15], atol=1e-4)


def test_mixed_pixels_are_those_on_a_depth_edge():
    post = oracles.quad([(-0.2, -1, -2), (0.205, -1, -2), (0.205, 1, -2), (-0.2, 1, -2)], Material(albedo=0.5))
    scene = Scene("post", (oracles.wall(3.0, 0.5, half_size_m=20), post), oracles.camera(64, 4, 34))
    transient = render(scene, DIRECT)
    edges = scene.camera.focal_px * np.array([-0.2, 0.205]) / 2 + 32
    assert set(np.flatnonzero(transient.mixed.all(axis=0))) == set(edges.astype(int))
    assert transient.mixed.sum() == 2 * 4


def test_ambient_furnace():
    """In a closed box whose walls emit L and reflect albedo a, every pixel sees L (1 + a + a^2 + ...)."""
    vertices, faces, uv = box((4, 4, 4))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=0.5), uv=uv, emission=0.3)
    ambient = render(Scene("furnace", (walls,), oracles.camera(16, 12, 60)), RenderSettings(bounces=1)).ambient
    assert abs(ambient.mean() / (0.3 / (1 - 0.5)) - 1) < 0.01
    constant = Scene(
        "sky", (oracles.wall(2.0, 0.5, half_size_m=0.1),), oracles.camera(16, 12, 60), ambient=Ambient(0.7)
    )
    assert np.allclose(render(constant, RenderSettings(bounces=1)).ambient[0], 0.7)
