"""Direct light against closed forms and float64 quadratures: grazing planes, silhouettes, wires, shadow edges."""

import warnings
from typing import NamedTuple

import numpy as np
import pytest

from render.direct.integrator import DirectLight, direct_light
from render.scene.traced_scene import TracedScene, dr
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import sphere


class Moments(NamedTuple):
    """Per pixel, (H, W): radiance, its mean path and standard deviation of path [m]."""

    total: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray


def quad(corners: list, material: Material | None = None, *, uv: bool = False) -> Surface:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) if uv else None
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Surface(np.array(corners, float), faces, material or Material(albedo=0.5), uv=square)


def wall(z_m: float, half_size_m: float = 20.0, material: Material | None = None, *, uv: bool = False) -> Surface:
    h = half_size_m
    return quad([(-h, -h, z_m), (h, -h, z_m), (h, h, z_m), (-h, h, z_m)], material, uv=uv)


def camera(width: int, height: int, fov_deg: float) -> Camera:
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def direct(scene: Scene, grid: int = 2, **options) -> DirectLight:
    view = scene.camera
    options = {"edge_threshold": 0.04, **options}
    return direct_light(TracedScene(scene), np.arange(view.width * view.height), grid, **options)


def moments(scene: Scene, light: DirectLight) -> Moments:
    pixels, samples = scene.camera.width * scene.camera.height, light.samples

    def sums(weight: np.ndarray) -> np.ndarray:
        return np.bincount(samples.pixel, weights=weight, minlength=pixels)

    total = sums(samples.radiance)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums(samples.radiance * samples.path_m) / total
        apart = samples.path_m - mean[samples.pixel]
        deviation = np.sqrt(sums(samples.radiance * (apart**2 + samples.half_width_m**2 / 3)) / total)
    shape = (scene.camera.height, scene.camera.width)
    return Moments(total.reshape(shape), mean.reshape(shape), deviation.reshape(shape))


def quadrature(scene: Scene, radiance_and_path, node: np.ndarray, weight: np.ndarray) -> Moments:
    """Float64 quadrature over every pixel; `node` and `weight` on [0, 1], the function takes rays (H, W, n, 3)."""
    column, row = np.meshgrid(np.arange(scene.camera.width), np.arange(scene.camera.height))
    offset_x, offset_y = (grid.ravel() for grid in np.meshgrid(node, node))
    rays = scene.camera.rays(column[..., None] + offset_x, row[..., None] + offset_y)
    radiance, path = radiance_and_path(rays)
    radiance = radiance * np.outer(weight, weight).ravel()
    total = radiance.sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (radiance * path).sum(-1) / total
        deviation = np.sqrt((radiance * (path - mean[..., None]) ** 2).sum(-1) / total)
    return Moments(total, mean, deviation)


def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    node, weight = np.polynomial.legendre.leggauss(count)
    return (node + 1) / 2, weight / 2


def intensity(scene: Scene) -> float:
    return float(scene.laser.intensity(scene.camera)[0, 0])


@pytest.mark.parametrize(("incidence_deg", "fov_deg"), [(80, 12), (89, 1.2), (89.9, 0.12)])
@pytest.mark.parametrize("grid", [1, 2])
def test_grazing_plane(incidence_deg, fov_deg, grid):
    """Lambertian plane n . x = h: L = albedo / pi I u / d^2 at d = h / u with u = n . r; u grows fourfold overall."""
    s, c = np.sin(np.radians(incidence_deg)), np.cos(np.radians(incidence_deg))
    along, across, foot = np.array([c, 0, -s]), np.array([0.0, 1, 0]), np.array([0, 0, -3.0])
    corners = [foot + a * along + b * across for a, b in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    scene = Scene("grazing", (quad(corners),), camera(12, 8, fov_deg))
    height, normal = 3 * c, np.array([-s, 0, -c])

    def plane(rays):
        u = rays @ normal
        return 0.5 / np.pi * intensity(scene) * u**3 / height**2, 2 * height / u

    expected = quadrature(scene, plane, *gauss(16))
    light = direct(scene, grid)
    got = moments(scene, light)
    assert np.abs(got.total / expected.total - 1).max() < 1e-3
    assert (np.abs(got.mean - expected.mean) < 0.01 * expected.deviation).all()
    assert np.abs(got.deviation / expected.deviation - 1).max() < 0.01
    assert light.clipped == 0 and not light.mixed.any()


def test_floor_up_to_its_end_at_the_horizon():
    """A floor 1.5 m below, 400 m long; its rows above 89 degrees are thinner than a cell of the first grid."""
    floor = quad([(-800, -1.5, 10), (800, -1.5, 10), (800, -1.5, -400), (-800, -1.5, -400)])
    scene = Scene("floor", (floor,), camera(12, 32, 20))

    def plane(rays):
        u = np.maximum(-rays[..., 1], 1e-12)
        seen = 1.5 / u * -rays[..., 2] < 400
        return np.where(seen, 0.5 / np.pi * intensity(scene) * u**3 / 1.5**2, 0), 3 / u

    expected = quadrature(scene, plane, *gauss(64))
    light = direct(scene)
    got = moments(scene, light)
    assert got.total.sum() == pytest.approx(expected.total.sum(), rel=1e-4)
    whole = expected.total[:, 0] > 0
    whole[np.flatnonzero(whole)[0]] = False  # the row that holds the horizon
    assert np.abs(got.total[whole] / expected.total[whole] - 1).max() < 2e-3
    assert (np.abs(got.mean - expected.mean)[whole] < 0.01 * expected.deviation[whole]).all()
    assert (light.samples.path_m + light.samples.half_width_m).max() < 2 * np.hypot(410, 100)


def test_footprint_ends_where_its_face_ends():
    """A strip of 4 x 10 cm, edge on at 89.5 degrees and unrefined: the tangent plane would spread over decimetres."""
    s, c = np.sin(np.radians(89.5)), np.cos(np.radians(89.5))
    near, far = np.array([0, 0, -2.0]), np.array([0, 0, -2.0]) + 0.1 * np.array([0, c, -s])
    strip = [end + [side * 0.02, 0, 0] for end, side in ((near, -1), (near, 1), (far, 1), (far, -1))]
    scene = Scene("strip", (quad(np.array(strip) - [0, 1e-4, 0]),), camera(9, 9, 20))
    light = direct(scene, 1, refine=0)
    assert len(light.samples.pixel) > 0 and light.clipped > 0
    corner = 2 * np.hypot(2.1, 0.02)
    assert (light.samples.path_m - light.samples.half_width_m).min() > 4.0 - 1e-3
    assert (light.samples.path_m + light.samples.half_width_m).max() < corner


@pytest.mark.parametrize("angle_deg", [85, 87, 89])
@pytest.mark.parametrize("grid", [1, 3])
def test_footprints_of_cut_cells_end_where_their_face_ends(angle_deg, grid):
    """A strip of 40 x 50 cm, nearly edge on: rays of cut cells are beside their middles, whose points on the tangent
    plane may lie metres beyond the face. A bound by tangents is short by what its width bends the path."""
    s, c, wide = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg)), 0.4
    near, far = np.array([0, -1e-4, -2.0]), np.array([0, -1e-4, -2.0]) + 0.5 * np.array([0, c, -s])
    strip = [end + [side * wide / 2, 0, 0] for end, side in ((near, -1), (near, 1), (far, 1), (far, -1))]
    light = direct(Scene("strip", (quad(strip),), camera(9, 9, 20)), grid, refine=1, edge_threshold=1)
    assert len(light.samples.pixel) > 0 and light.clipped > 0
    assert (light.samples.path_m - light.samples.half_width_m).min() > 4.0 - wide**2 / 2
    assert (light.samples.path_m + light.samples.half_width_m).max() < 2 * np.linalg.norm(strip[2]) + 1e-5


def test_sphere_limb():
    """Sphere: d = c - sqrt(r^2 - s^2), cosine from the normal; midpoint rule, since the limb is not smooth."""
    vertices, faces, _ = sphere(0.5, 7)
    scene = Scene("sphere", (Surface(vertices + [0, 0, -3], faces, Material(albedo=0.5)),), camera(12, 9, 24))

    def ball(rays):
        along = -rays[..., 2] * 3
        root2 = 0.25 - 9 + along**2
        distance = along - np.sqrt(np.maximum(root2, 0))
        cosine = -((rays * distance[..., None] + [0, 0, 3]) * rays).sum(-1) / 0.5
        return np.where(root2 > 0, 0.5 / np.pi * intensity(scene) * cosine / distance**2, 0), 2 * distance

    side = 128
    expected = quadrature(scene, ball, (np.arange(side) + 0.5) / side, np.full(side, 1 / side))
    light = direct(scene, edge_threshold=0)
    got = moments(scene, light)
    limb = light.mixed.reshape(got.total.shape) & (expected.total > 0.02 * expected.total.max())
    assert 12 < limb.sum() < 60
    assert np.abs(got.total[limb] / expected.total[limb] - 1).max() < 0.01
    assert np.abs(got.mean - expected.mean)[limb].max() < 5e-4
    assert got.total.sum() == pytest.approx(expected.total.sum(), rel=1e-3)


def test_wire_of_a_fifth_of_a_pixel_is_found_along_its_whole_length():
    """A slanted strip at 2 m before a wall at 3 m: L = albedo / pi I cos^3 / z^2 on both, the strip's area hides."""
    view = camera(64, 12, 30)
    slope, width_px, centre_px = 0.03, 0.2, 6.3
    x_px = np.array([-40.0, 40])
    ends = [
        (x, centre_px - 6 + slope * x + side * width_px / 2)
        for x, side in zip(x_px[[0, 1, 1, 0]], (1, 1, -1, -1), strict=True)
    ]
    strip = quad([(2 * x / view.focal_px, -2 * y / view.focal_px, -2.0) for x, y in ends], Material(albedo=0.8))
    back = wall(-3.0)
    scene, bare = Scene("wire", (back, strip), view), Scene("wall", (back,), view)

    def lambertian(albedo, z, x, y):
        return albedo / np.pi * intensity(scene) * (1 + (x**2 + y**2) / view.focal_px**2) ** -2.5 / z**2 * 1.0

    node, weight = gauss(8)
    x = np.arange(-32, 32)[:, None] + node
    y = centre_px - 6 + slope * x
    # cos / d^2 = cos^3 / z^2 with cos = 1 / sqrt(1 + tan^2)
    on_strip = lambertian(0.8, 2.0, x, y) * (1 + (x**2 + y**2) / view.focal_px**2)
    hidden = lambertian(0.5, 3.0, x, y) * (1 + (x**2 + y**2) / view.focal_px**2)
    expected, hides = (width_px * (v * weight).sum(1) for v in (on_strip, hidden))

    light = direct(scene)
    near = light.samples.path_m < 5
    got = np.bincount(light.samples.pixel[near] % 64, weights=light.samples.radiance[near], minlength=64)
    assert got.sum() == pytest.approx(expected.sum(), rel=0.02)
    assert np.abs(got / expected - 1).max() < 0.15
    behind = light.samples.radiance[~near].sum()
    lost = direct(bare).samples.radiance.sum() - behind
    assert lost == pytest.approx(hides.sum(), rel=0.02)
    y_at = centre_px + slope * (np.arange(64) + 0.5 - 32)
    assert light.mixed[y_at.astype(int) * 64 + np.arange(64)].all()


@pytest.mark.parametrize("covered", [0.08, 0.24, 0.41, 0.67, 0.93])
def test_an_edge_along_columns_of_cells_is_found_to_a_part_of_a_cell(covered):
    """Rays in the middle of the finest cells, 1/32 of a pixel, would all fall on the same side: up to 1/64 off."""
    view = camera(8, 8, 10)
    edge = 2 * (5 + covered - 4) / view.focal_px
    near = quad([(-5, -5, -2), (edge, -5, -2), (edge, 5, -2), (-5, 5, -2)])
    light = direct(Scene("edge", (wall(-3.0), near), view), refine=4, edge_threshold=0)
    front = light.samples.path_m < 5
    column = np.bincount(light.samples.pixel[front] % 8, weights=light.samples.radiance[front])
    assert abs(column[5] / column[4] - covered) < 1 / 64 / 3


@pytest.mark.parametrize("covered", [0.1, 0.37, 0.8])
def test_share_of_a_half_covered_pixel(covered):
    view = camera(8, 4, 10)
    edge = 2 * (5 + covered - 4) / view.focal_px
    near = quad([(-5, -5, -2), (edge, -5, -2), (edge, 5, -2), (-5, 5, -2)])
    light = direct(Scene("edge", (wall(-3.0), near), view))
    front = light.samples.path_m < 5
    energy = np.bincount(light.samples.pixel[front], weights=light.samples.radiance[front], minlength=32).reshape(4, 8)
    assert np.abs(energy[:, 5] / energy[:, 4] - covered).max() < 1 / 32 + 0.005
    assert light.mixed.reshape(4, 8)[:, 5].all() and light.mixed.sum() == 4


def test_shadow_edge_of_a_displaced_laser():
    """The laser at x = 0.1 m sees the post's edge x = -0.1 m at 1 m before x = -0.3 m of the wall at 2 m."""
    view, laser = camera(40, 6, 30), Laser("flood", (0.1, 0, 0), 60)
    back = wall(-2.0)
    post = quad([(-0.1, -1, -1), (0, -1, -1), (0, 1, -1), (-0.1, 1, -1)])
    bare = moments(Scene("bare", (back,), view, laser), direct(Scene("bare", (back,), view, laser)))
    scene = Scene("post", (back, post), view, laser)
    light = direct(scene, edge_threshold=0)
    got = moments(scene, light)
    edge = -0.3 / 2 * view.focal_px + 20
    assert np.abs(got.total[:, int(edge)] / bare.total[:, int(edge)] - edge % 1).max() < 0.02
    # the wall in shadow is still a wall: only the edge of the post itself is mixed
    assert set(np.flatnonzero(light.mixed.reshape(6, 40).any(axis=0))) == {int(20 - 0.1 * view.focal_px)}
    unrefined = direct(scene, refine=0)
    assert unrefined.rays == 4 * 240 < light.rays


@pytest.mark.parametrize("baseline_m", [(0, 0, 0), (0.1, 0, 0)])
def test_edges_of_paint_are_followed_and_are_no_silhouettes(baseline_m):
    # half of the wall is painted black, and the border lies where no row of cells does
    view, laser, border_m = camera(24, 24, 30), Laser("flood", baseline_m, 60), 0.0137
    halves = ((-3, border_m, 0.0), (border_m, 3, 1.0))
    painted = tuple(
        quad([(a, -3, -2), (b, -3, -2), (b, 3, -2), (a, 3, -2)], Material(albedo=albedo)) for a, b, albedo in halves
    )
    scene = Scene("painted", painted, view, laser)
    white = Scene("white", (wall(-2.0, 3.0, Material(albedo=1.0)),), view, laser)
    column = border_m / 2 * view.focal_px + 12
    followed, left = direct(scene, edge_threshold=0.01), direct(scene, refine=0)
    whole = moments(white, direct(white)).total[:, int(column)]
    off, off_before = (
        np.abs(moments(scene, light).total[:, int(column)] / whole - (1 - column % 1)).max()
        for light in (followed, left)
    )
    assert left.rays == 4 * 576 < followed.rays
    assert not followed.mixed.any()
    assert off < 0.02 < 0.05 < off_before


def test_edges_not_worth_a_cut_round_to_no_side():
    """With rays in the middle of cells all rows would round an upright border alike, by up to half a cell."""
    view, grid, height = camera(24, 48, 30), 4, 48
    left, right = -0.061, 0.083  # 3.2 pixels to the right over the image's height, 0.07 over a row's
    black = quad([(-3, -3, -2), (left, -3, -2), (right, 3, -2), (-3, 3, -2)], Material(albedo=0.0))
    half = quad([(left, -3, -2), (3, -3, -2), (3, 3, -2), (right, 3, -2)], Material(albedo=1.0))
    scenes = Scene("white", (wall(-2.0, 3.0, Material(albedo=1.0)),), view), Scene("painted", (black, half), view)
    whole, found = (moments(scene, direct(scene, grid, refine=0)).total for scene in scenes)
    y_m = (height / 2 - (np.arange(height * 64) + 0.5) / 64) * 2 / view.focal_px
    border = (left + (right - left) * (y_m + 3) / 6) * view.focal_px / 2 + 12
    covered = np.clip(np.arange(1, 25) - border[:, None], 0, 1).reshape(height, 64, 24).mean(axis=1)
    off = ((found - whole * covered) / whole).sum(axis=1)
    assert np.sqrt(np.square(off).mean()) < 0.6 / (grid * np.sqrt(12))
    assert abs(off.mean()) < 0.1 / grid


MATERIALS = (
    Material(albedo=0.6),
    Material("roughplastic", albedo=0.4, roughness=0.3),
    Material("roughconductor", roughness=0.4, eta=1.5, k=6.0),
)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.kind)
@pytest.mark.parametrize(
    ("mode", "baseline_m"),
    [("flood", (0, 0, 0)), ("flood", (0.15, 0.05, 0)), ("line", (0.15, 0, 0)), ("scan", (0, 0, 0))],
)
def test_refined_cells_agree_with_a_fine_grid(material, mode, baseline_m):
    vertices, faces, _ = sphere(0.4, 4)
    ball = Surface(vertices + [0.1, 0, -2], faces, material)
    scene = Scene("ball", (wall(-3.0, material=material), ball), camera(12, 10, 34), Laser(mode, baseline_m))
    got, fine = moments(scene, direct(scene)), moments(scene, direct(scene, 32, refine=0))
    # cells at silhouettes end where less than `edge_threshold` is left, the fine grid nowhere
    tolerance = {"diffuse": 8e-3, "roughplastic": 1e-2, "roughconductor": 2e-2}[material.kind]
    assert np.linalg.norm(got.total - fine.total) < tolerance * np.linalg.norm(fine.total)
    bright = fine.total > 0.05 * fine.total.max()
    assert np.median(np.abs(got.mean - fine.mean)[bright]) < 5e-4


def test_same_bytes_on_one_and_two_threads():
    vertices, faces, _ = sphere(0.5, 5)
    scene = Scene("ball", (wall(-3.0), Surface(vertices + [0, 0, -2], faces)), camera(32, 24, 40))
    before, found = dr.thread_count(), []
    try:
        for threads in (1, 2):
            dr.set_thread_count(threads)
            light = direct(scene)
            found.append([column.tobytes() for column in (*light.samples, light.mixed)])
    finally:
        dr.set_thread_count(before)
    assert found[0] == found[1]


def test_the_third_view_of_a_scene_compiles_nothing():
    vertices, faces, _ = sphere(0.5, 5)
    surfaces = (wall(-3.0), Surface(vertices + [0, 0, -2], faces, Material(albedo=0.3)))
    compiled = []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        for x in (0.0, 0.1, 0.2, 0.3):
            view = Camera.look_at((x, 0, 0), (0, 0, -2), fov_deg=40 + x, width=24, height=24)
            dr.kernel_history_clear()
            direct(Scene("view", surfaces, view))
            compiled.append(sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()))
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert compiled[2:] == [0, 0]


def degenerate(surface: Surface) -> Surface:
    """The surface and, on top of it, faces without area."""
    faces = np.concatenate((surface.faces, [[0, 0, 1], [1, 1, 1], [0, 1, 0]]))
    return Surface(surface.vertices, faces, surface.material)


def inverted(surface: Surface) -> Surface:
    return Surface(surface.vertices, surface.faces[:, ::-1], surface.material)


@pytest.mark.parametrize("case", ["duplicated", "degenerate", "inverted", "coplanar"])
def test_faulty_meshes_return_what_sound_ones_do(case):
    sound = wall(-2.0)
    faulty = {
        "duplicated": (sound, Surface(sound.vertices, np.tile(sound.faces, (2, 1)), sound.material)),
        "degenerate": (degenerate(sound),),
        "inverted": (inverted(sound),),
        "coplanar": (sound, inverted(wall(-2.0, 30.0))),
    }[case]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenes = [Scene(case, surfaces, camera(16, 12, 40)) for surfaces in ((sound,), faulty)]
        lights = [direct(scene) for scene in scenes]
    expected, got = (moments(scene, light) for scene, light in zip(scenes, lights, strict=True))
    assert np.allclose(got.total, expected.total, rtol=1e-4) and np.allclose(got.mean, expected.mean, atol=1e-5)
    assert not lights[1].mixed.any()


@pytest.mark.parametrize("z_m", [-0.05, 1.0])
@pytest.mark.parametrize("refine", [0, 4])
def test_close_and_absent_surfaces(z_m, refine):
    scene = Scene("close", (wall(z_m, 0.5),), camera(16, 12, 60))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        light = direct(scene, refine=refine)
    assert all(np.isfinite(column).all() for column in light.samples)
    if z_m > 0:
        assert len(light.samples.pixel) == 0 and not light.mixed.any()
        return
    got = moments(scene, light)
    cosine = -scene.camera.rays()[..., 2]
    assert np.abs(got.mean * cosine / 0.1 - 1).max() < 2e-3


def test_a_few_pixels_are_what_they_are_in_the_whole_image():
    scene = Scene("plane", (wall(-2.0),), camera(16, 12, 40))
    chosen = np.array([3, 17, 18, 90, 191])
    whole, part = (direct_light(TracedScene(scene), pixels, 2, 0.0) for pixels in (np.arange(16 * 12), chosen))
    # cells at the edge of lone pixels have one neighbour to follow and no bend: (c_x + c_y) / 24 is missing, where a
    # cell of w = 1/2 pixel = 45 mm at d = 2 m has c = 2 w^2 / d = 2 mm
    a, b = (moments(scene, light) for light in (whole, part))
    assert set(part.samples.pixel.tolist()) == set(chosen.tolist())
    assert a.total.ravel()[chosen] == pytest.approx(b.total.ravel()[chosen], rel=1e-6)
    assert a.mean.ravel()[chosen] == pytest.approx(b.mean.ravel()[chosen], abs=2e-4)
    assert len(direct_light(TracedScene(scene), chosen[:0], 2).samples.pixel) == 0
