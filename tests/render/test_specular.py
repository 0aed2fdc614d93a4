"""Mirrors, coats, windows, slabs and cut-outs against closed forms of the image method."""

import math
from dataclasses import replace

import numpy as np
import pytest

from render import RenderSettings, render
from render.direct.integrator import centre_layers, direct_light
from render.scene.traced_scene import TracedScene
from render.specular.image_method import specular_light
from render.specular.mirrors import check_slabs, find_mirrors, slab_error_m
from scenes import Camera, InputError, Laser, Material, Scene, Surface, Texture
from scenes.geometry.shapes import axis_frame, box, sphere

GOOD_MIRROR = Material("conductor", eta=0.0, k=1.0, specular=0.8, name="mirror")
SILVER = Material("conductor", eta=0.2, k=3.0, name="silver")
N = 1.5
F = ((N - 1) / (N + 1)) ** 2


def quad(corners, material: Material, name: str = "quad", uv=None) -> Surface:
    return Surface(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], material, uv=uv, name=name)


def square(centre, normal, half: float, material: Material, name: str = "square") -> Surface:
    """A square around `centre`, perpendicular to `normal`."""
    frame = axis_frame(np.array(normal, float) / np.linalg.norm(normal))
    corners = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)]
    return quad(np.array(corners) @ frame.T + centre, material, name)


def camera(width: int = 33, height: int = 25, fov_deg: float = 34.0) -> Camera:
    """At the origin, looking along -z; an odd size puts a pixel's centre on the axis."""
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def scene_of(*surfaces: Surface, laser: Laser | None = None, view: Camera | None = None) -> Scene:
    return Scene("specular", surfaces, view or camera(), laser or Laser())


def glint(scene: Scene, toward, reflectance: float, one_way_m: float) -> tuple[int, float]:
    """Pixel and radiance R I F^2 / (D^2 cos^3) of the laser seen in the direction `toward`."""
    view = scene.camera
    x, y, z = np.array(toward, float) @ view.rotation / np.linalg.norm(toward)
    column = math.floor(view.focal_px * x / z + view.width / 2)
    row = math.floor(view.focal_px * y / z + view.height / 2)
    per_pixel = scene.laser.intensity(view)[row, column] * view.focal_px**2 / z**3
    return row * view.width + column, reflectance * per_pixel / one_way_m**2


def check(scene: Scene, expected: list[tuple], *, energy: float = 1e-4, path_m: float = 1e-4) -> None:
    """The scene's specular samples are exactly those expected: (toward, reflectance, D, path, bounces) each."""
    samples = specular_light(TracedScene(scene)).samples
    assert len(samples.pixel) == len(expected), samples
    order = np.argsort(samples.path_m)
    for i, (toward, reflectance, one_way, path, bounces) in zip(
        order, sorted(expected, key=lambda e: e[3]), strict=True
    ):
        pixel, radiance = glint(scene, toward, reflectance, one_way)
        assert samples.pixel[i] == pixel
        assert samples.radiance[i] == pytest.approx(radiance, rel=energy)
        assert abs(samples.path_m[i] - path) < path_m and samples.half_width_m[i] < 1e-6
        assert samples.bounces[i] == bounces


def fresnel_metal(cosine: float, material: Material) -> float:
    """Unpolarised reflectance of a metal, from the complex amplitudes."""
    index = material.eta - 1j * material.k
    inner = np.sqrt(1 - (1 - cosine**2) / index**2)
    s, p = (cosine - index * inner) / (cosine + index * inner), (index * cosine - inner) / (index * cosine + inner)
    return material.specular * (abs(s) ** 2 + abs(p) ** 2) / 2


@pytest.mark.parametrize("mode", ["flood", "line", "scan"])
@pytest.mark.parametrize("distance_m", [0.5, 3.0, 14.0])
def test_frontal_mirror(distance_m, mode):
    mirror = square((0.3, 0.1, -distance_m), (0, 0, 1), 1, GOOD_MIRROR)
    expected = [((0, 0, -1), 0.8, 2 * distance_m, 2 * distance_m, 1)]
    check(scene_of(mirror, laser=Laser(mode)), expected)
    turned = replace(mirror, faces=mirror.faces[:, ::-1])
    check(scene_of(turned, laser=Laser(mode)), expected)


@pytest.mark.parametrize("tilt_deg", [3, 10])
def test_tilted_mirror_shines_where_its_normal_meets_the_camera(tilt_deg):
    normal = np.array([math.sin(math.radians(tilt_deg)), 0, math.cos(math.radians(tilt_deg))])
    mirror = square(-2 * normal + (0, 0.2, 0), normal, 0.5, SILVER)
    check(scene_of(mirror), [(-normal, fresnel_metal(1, SILVER), 4, 4, 1)])
    aside = square(-2 * normal + (0, 0.6, 0), normal, 0.5, SILVER)
    check(scene_of(aside), [])


def test_half_of_a_glint_on_the_edge_of_a_mirror():
    mirror = quad([(0, -1, -2), (1, -1, -2), (1, 1, -2), (0, 1, -2)], GOOD_MIRROR)
    samples = specular_light(TracedScene(scene_of(mirror))).samples
    _, whole = glint(scene_of(mirror), (0, 0, -1), 0.8, 4)
    assert samples.radiance.sum() == pytest.approx(whole / 2, rel=0.15)


def test_a_mirror_twice_in_one_plane_shines_once():
    mirror = square((0, 0, -2), (0, 0, 1), 1, GOOD_MIRROR)
    patch = square((0.1, 0, -2), (0, 0, -1), 0.5, replace(GOOD_MIRROR))
    check(scene_of(mirror, patch), [((0, 0, -1), 0.8, 4, 4, 1)])


def test_displaced_laser_in_a_mirror():
    """D = |L' - C|; the mirror point halves the way sideways; a metal reflects by the angle there."""
    mirror = square((0, 0, -2), (0, 0, 1), 1, SILVER)
    baseline = np.array([0.2, 0.1, 0.0])  # camera frame: y down
    image = np.array([0.2, -0.1, -4.0])
    one_way = float(np.linalg.norm(image))
    reflectance = fresnel_metal(4 / one_way, SILVER)
    scene = scene_of(mirror, laser=Laser("flood", tuple(baseline), 40.0))
    check(scene, [(image, reflectance, one_way, one_way, 1)])
    steered = scene_of(mirror, laser=Laser("scan", tuple(baseline)))
    check(steered, [(image, reflectance, one_way, one_way, 1)])


def test_nothing_from_a_blocked_or_unlit_mirror():
    mirror = square((0, 0, -2), (0, 0, 1), 1, GOOD_MIRROR)
    post = square((0, 0, -1), (0, 0, 1), 0.1, Material(albedo=0.5))
    assert (specular_light(TracedScene(scene_of(mirror, post))).samples.bounces > 1).all()
    check(scene_of(mirror, square((0.5, 0, -1), (0, 0, 1), 0.1, Material(albedo=0.0))), [((0, 0, -1), 0.8, 4, 4, 1)])
    tilted = square((0, 0, -2), (math.sin(0.2), 0, math.cos(0.2)), 1, GOOD_MIRROR)
    assert len(specular_light(TracedScene(scene_of(tilted))).samples.pixel) == 1
    check(scene_of(tilted, laser=Laser("flood", cone_deg=20.0)), [])
    hidden_laser = scene_of(mirror, square((0.2, 0, -0.5), (0, 0, 1), 0.05, Material(albedo=0)),
                            laser=Laser("flood", (0.25, 0, 0), 60.0))  # fmt: skip
    assert not (specular_light(TracedScene(hidden_laser)).samples.bounces == 1).any()


def corner_cube(apex, turn_deg: float, size_m: float, material: Material) -> list[Surface]:
    """Three squares at right angles, open toward +z, turned about x."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    edges = np.array([(1, 0, 0), (0, c, -s), (0, s, c)]) @ axis_frame(np.ones(3) / math.sqrt(3)).T * size_m
    a, b, e = edges.T
    return [quad([apex, apex + u, apex + u + v, apex + v], material) for u, v in ((a, b), (b, e), (e, a))]


@pytest.mark.parametrize("turn_deg", [0, 7, -12])
@pytest.mark.parametrize("apex", [(0.0, 0.0, -2.0), (0.3, -0.2, -3.0), (-0.1, 0.05, -0.5), (1.1, 0.7, -10.0)])
def test_corner_cube_returns_the_distance_to_its_apex(apex, turn_deg):
    apex = np.array(apex)
    one_way = 2 * float(np.linalg.norm(apex))
    check(scene_of(*corner_cube(apex, turn_deg, 0.1, GOOD_MIRROR)), [(apex, 0.8**3, one_way, one_way, 3)], path_m=1e-5)


def test_corner_cube_of_silver_reflects_by_its_three_angles():
    apex = np.array([0.1, 0.0, -2.0])
    faces = corner_cube(apex, 5, 0.1, SILVER)
    away = apex / np.linalg.norm(apex)
    normals = [np.cross(*(s.vertices[[1, 3]] - s.vertices[0])) / 0.01 for s in faces]
    reflectance = math.prod(fresnel_metal(abs(n @ away), SILVER) for n in normals)
    one_way = 2 * float(np.linalg.norm(apex))
    check(scene_of(*faces), [(apex, reflectance, one_way, one_way, 3)])


def test_plastic_coat_glints():
    wall = square((0, 0, -2), (0, 0, 1), 1, Material("plastic", albedo=0.4, ior=N, specular=0.7))
    check(scene_of(wall), [((0, 0, -1), 0.7 * F, 4, 4, 1)])


def test_thin_pane_before_a_mirror():
    """Own return 2F/(1+F); the mirror through the pane twice, (1-F)/(1+F) each; light between the two is left out."""
    pane = square((0, 0, -1), (0, 0, 1), 1, Material("thindielectric", ior=N))
    mirror = square((0, 0, -2), (0.03, 0, 1), 1, GOOD_MIRROR)
    normal = np.array([0.03, 0, 1]) / math.hypot(0.03, 1)
    d = 2 * normal[2]
    passed = ((1 - F) / (1 + F)) ** 2
    samples = specular_light(TracedScene(scene_of(pane, mirror))).samples
    first = samples.bounces == 1
    for toward, reflectance, one_way in (((0, 0, -1), 2 * F / (1 + F), 2), (-normal, 0.8 * passed, 2 * d)):
        pixel, radiance = glint(scene_of(pane), toward, reflectance, one_way)
        found = first & (np.abs(samples.path_m - one_way) < 1e-4)
        assert samples.pixel[found] == [pixel] and samples.radiance[found] == pytest.approx(radiance, rel=2e-4)
    assert first.sum() == 2


def slab(z: float, thickness_m: float, ior: float = N, half: float = 1.0) -> Surface:
    """A slab of glass whose front is at z."""
    vertices, faces, uv = box((2 * half, 2 * half, thickness_m))
    return Surface(vertices + [0, 0, z - thickness_m / 2], faces, Material("dielectric", ior=ior), uv=uv, name="slab")


def test_slab_returns_from_front_and_back():
    """F at 2d; T^2 F at 2(d + n t), spread over 2(d + t/n)."""
    t, d = 0.3, 1.0
    expected = [
        ((0, 0, -1), F, 2 * d, 2 * d, 1),
        ((0, 0, -1), (1 - F) ** 2 * F, 2 * (d + t / N), 2 * (d + N * t), 1),
    ]
    check(scene_of(slab(-d, t)), expected, energy=3e-4, path_m=2e-4)


@pytest.mark.parametrize("glasses", [(1.5,), (1.33, 1.8)])
def test_a_wall_behind_slabs_is_dimmed_delayed_and_brightened_by_their_spreading(glasses):
    """Head on: (1-F)^4 each, path + 2t(n-1), irradiance over (d - sum t(1-1/n))^2. So for a laser beside the camera."""
    t, d = 0.4, 3.0
    wall, view = square((0, 0, -d), (0, 0, 1), 20, Material(albedo=0.5)), camera(5, 5, 0.5)
    slabs = [slab(-0.5 - i, t, n) for i, n in enumerate(glasses)]
    for laser in (Laser(), Laser("flood", (1e-3, 0, 0), 2.0)):
        pixels = np.arange(25)
        bare = direct_light(TracedScene(scene_of(wall, view=view, laser=laser)), pixels, 2).samples
        seen = direct_light(TracedScene(scene_of(wall, *slabs, view=view, laser=laser)), pixels, 2).samples
        near = d - sum(t * (1 - 1 / n) for n in glasses)
        dimmed = math.prod((1 - ((n - 1) / (n + 1)) ** 2) ** 4 for n in glasses)
        ratio = seen.radiance.sum() / bare.radiance.sum()
        assert ratio == pytest.approx(dimmed * (d / near) ** 2, rel=5e-4)
        delay = np.average(seen.path_m, weights=seen.radiance) - np.average(bare.path_m, weights=bare.radiance)
        assert delay == pytest.approx(2 * sum(t * (n - 1) for n in glasses), abs=2e-4)


@pytest.mark.parametrize("angle_deg", [0, 20, 45, 60, 75])
@pytest.mark.parametrize("thick", [False, True])
def test_tilted_glass_dims_by_its_angle(angle_deg, thick):
    """T^2 of Fresnel's equations, unpolarised: (1-F)/(1+F) for a pane, (1-F)^2 for a slab (here a thin one)."""
    a = math.radians(angle_deg)
    b = math.asin(math.sin(a) / N)
    s = ((math.cos(a) - N * math.cos(b)) / (math.cos(a) + N * math.cos(b))) ** 2
    p = ((N * math.cos(a) - math.cos(b)) / (N * math.cos(a) + math.cos(b))) ** 2
    fresnel = (s + p) / 2
    passed = (1 - fresnel) ** 2 if thick else (1 - fresnel) / (1 + fresnel)
    turn = np.array([(math.cos(a), 0, math.sin(a)), (0, 1, 0), (-math.sin(a), 0, math.cos(a))])
    glass = slab(0, 1e-3, half=2) if thick else square((0, 0, 0), (0, 0, 1), 2, Material("thindielectric", ior=N))
    glass = replace(glass, vertices=glass.vertices @ turn.T + (0, 0, -1.5))
    wall, view = square((0, 0, -4), (0, 0, 1), 9, Material(albedo=0.5)), camera(3, 3, 0.2)
    bare = direct_light(TracedScene(scene_of(wall, view=view)), np.arange(9), 2).samples
    seen = direct_light(TracedScene(scene_of(wall, glass, view=view)), np.arange(9), 2).samples
    assert seen.radiance.sum() / bare.radiance.sum() == pytest.approx(passed**2, rel=2e-3)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_wall_seen_in_a_mirror(tilt):
    """The wall's image by the unfolded geometry: R^2 f cos I / D^2 at path 2D, and nothing else three surfaces long."""
    # a mirror at 45 degrees shows a wall to the right of the camera
    mirror = square((0, 0, -2), (1, 0, 1), 3, GOOD_MIRROR)
    wall = square((3, 0, -2), (-1, 0, tilt), 9, Material(albedo=0.5))
    view = camera(17, 13, 20)
    samples = specular_light(TracedScene(scene_of(mirror, wall, view=view)), 4).samples
    assert set(samples.bounces) == {3}
    # the image of the wall: x and z + 2 swap with opposite signs
    x, y, z = wall.vertices.T
    unfolded = replace(wall, vertices=np.column_stack((-(z + 2), y, -x - 2)))
    plain = direct_light(TracedScene(scene_of(unfolded, view=view)), np.arange(17 * 13), 4).samples
    got, want = (np.bincount(s.pixel, s.radiance, 17 * 13) for s in (samples, plain))
    assert np.abs(got / (0.64 * want) - 1).max() < 1e-4
    moments = [np.bincount(s.pixel, s.radiance * s.path_m, 17 * 13) for s in (samples, plain)]
    assert np.abs(moments[0] / got - moments[1] / want).max() < 3e-4
    deviation = []
    for s, moment, energy in zip((samples, plain), moments, (got, want), strict=True):
        apart = s.path_m - (moment / energy)[s.pixel]  # about the mean: squares of paths are lost to rounding
        spread = np.bincount(s.pixel, s.radiance * (apart**2 + s.half_width_m**2 / 3), 17 * 13)
        deviation.append(np.sqrt(spread / energy))
    assert np.abs(deviation[0] - deviation[1]).max() < 2e-3 + 0.02 * deviation[1].max()


def test_a_wall_lit_by_way_of_a_mirror():
    """The pixel sees the wall itself: albedo/pi R I cos / |x - L'|^2 at path |x| + |x - L'|, wherever the beam goes."""
    mirror = square((1, 0, -2), (-1, 0, 0), 5, GOOD_MIRROR)
    wall = square((0, 0, -3), (0, 0, 1), 0.9, Material(albedo=0.5))
    scene = scene_of(mirror, wall, laser=Laser("flood", cone_deg=180.0), view=camera(17, 13, 30))
    samples = specular_light(TracedScene(scene), 8).samples
    image = np.array([2.0, 0, 0])
    rays = scene.camera.rays()
    point = 3 * rays / -rays[..., 2:]
    leg = np.linalg.norm(point - image, axis=-1)
    seen = samples.bounces == 2
    got = np.bincount(samples.pixel[seen], samples.radiance[seen], 17 * 13).reshape(13, 17)
    want = 0.5 / math.pi * 0.8 / (2 * math.pi) * 3 / leg**3
    inner = (np.abs(point[..., :2]) < 0.7).all(axis=-1)
    assert inner.any() and np.abs(got / want - 1)[inner].max() < 1e-3
    path = np.bincount(samples.pixel[seen], (samples.radiance * samples.path_m)[seen], 17 * 13).reshape(13, 17) / got
    assert np.abs(path - np.linalg.norm(point, axis=-1) - leg)[inner].max() < 1e-3


def test_bounces_limit_mirrored_light_too():
    mirror = square((1, 0, -2), (-1, 0, 0), 5, GOOD_MIRROR)
    wall = square((0, 0, -3), (0, 0, 1), 0.9, Material(albedo=0.5))
    scene = scene_of(mirror, wall, laser=Laser("flood", cone_deg=180.0), view=camera(17, 13, 30))
    one, two = (render(scene, RenderSettings(bounces=most, grid=4, spp=4)) for most in (1, 2))
    assert set(one.bounces) == {1}
    mirrored = specular_light(TracedScene(scene), 4).samples
    wanted = mirrored.radiance[mirrored.bounces == 2].sum()  # the wall lit by way of the mirror
    assert two.radiance[two.bounces == 2].sum() == pytest.approx(wanted, rel=1e-3)


def test_displaced_laser_lights_a_wall_seen_in_a_mirror():
    mirror = square((0, 0, -2), (1, 0, 1), 3, GOOD_MIRROR)
    wall = square((3, 0, -2), (-1, 0, 0), 9, Material(albedo=0.5))
    laser = Laser("flood", (0, 0.2, 0), 60.0)
    samples = specular_light(TracedScene(scene_of(mirror, wall, laser=laser)), 2).samples
    unfolded = square((0, 0, -5), (0, 0, 1), 9, Material(albedo=0.5))
    plain = direct_light(TracedScene(scene_of(unfolded, laser=laser)), np.arange(33 * 25), 2).samples
    seen = samples.bounces == 3
    assert samples.radiance[seen].sum() == pytest.approx(0.64 * plain.radiance.sum(), rel=1e-3)
    assert np.average(samples.path_m[seen], weights=samples.radiance[seen]) == pytest.approx(
        np.average(plain.path_m, weights=plain.radiance), abs=1e-3
    )


def leaf(z: float, half: float) -> Surface:
    """A sheet whose right half is cut out."""
    holes = Texture(np.repeat([[1.0] * 8 + [0.0] * 8], 4, axis=0), "half")
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return quad(corners, Material(albedo=0.3, opacity=holes), "leaf", uv=[[0, 0], [1, 0], [1, 1], [0, 1]])


def test_light_passes_the_holes_of_a_leaf_both_ways():
    wall = square((0, 0, -2), (0, 0, 1), 9, Material(albedo=0.5))
    view = camera(33, 3, 40)
    x = view.rays()[1, :, 0] / -view.rays()[1, :, 2]
    depth = centre_layers(TracedScene(scene_of(wall, leaf(-1, 0.5), view=view))).depth_m[1] * -view.rays()[1, :, 2]
    off_edge = (np.abs(x) > 0.04) & (np.abs(np.abs(x) - 0.5) > 0.04)
    assert np.allclose(depth[off_edge], np.where((x > -0.5) & (x < 0), 1, 2)[off_edge], atol=1e-4)
    # a laser 0.4 m to the right: the shadow of x = -0.5 to 0 at 1 m falls on x = -1.4 to -0.4 at 2 m
    laser = Laser("flood", (0.4, 0, 0), 120.0)
    samples = direct_light(TracedScene(scene_of(wall, leaf(-1, 0.5), view=view, laser=laser)), np.arange(99), 4).samples
    far = samples.path_m > 3.5
    lit = np.bincount(samples.pixel[far], samples.radiance[far], 99).reshape(3, 33)[1] > 0
    on_wall, x = (x > 0.04) | (x < -0.54), 2 * x
    dark = (x > -1.4) & (x < -0.4)
    clear = on_wall & (np.abs(x + 1.4) > 0.08) & (np.abs(x + 0.4) > 0.08)
    assert np.array_equal(lit[clear], ~dark[clear])


def test_a_mirror_has_no_glint_in_its_holes():
    sheet = leaf(-2, 1)
    sheet = replace(sheet, material=replace(sheet.material, kind="conductor", eta=0.0, k=1.0, specular=0.8))
    left, right = (replace(sheet, vertices=sheet.vertices + (x, 0, 0)) for x in (0.4, -0.4))
    check(scene_of(left), [((0, 0, -1), 0.8, 4, 4, 1)])
    check(scene_of(right), [])


def test_depth_label_is_the_first_opaque_surface():
    wall = square((0, 0, -3), (0, 0, 1), 9, Material(albedo=0.5))
    pane = square((0, 0, -1), (0, 0, 1), 9, Material("thindielectric", ior=N))
    mirror = quad([(0, -9, -2), (9, -9, -2), (9, 9, -2), (0, 9, -2)], GOOD_MIRROR)
    view = camera(32, 3, 40)
    layers = centre_layers(TracedScene(scene_of(wall, pane, slab(-1.2, 0.2, half=9), mirror, view=view)))
    depth = layers.depth_m * -view.rays()[..., 2]
    assert np.allclose(depth, np.where(np.arange(32) < 16, 3, 2), atol=1e-4)


def test_slab_error_is_stated_and_refused_beside_a_displaced_laser():
    wall, glass = square((0, 0, -3), (0, 0, 1), 9, Material(albedo=0.5)), slab(-1, 0.3, half=2)
    (error,) = slab_error_m(TracedScene(scene_of(wall, glass)))
    a = math.atan(math.hypot(16.5, 12.5) / camera().focal_px)
    b = math.asin(math.sin(a) / N)
    assert error.thickness_m == pytest.approx(0.3)
    assert error.shift_m == pytest.approx(0.3 * math.sin(a - b) / math.cos(b), rel=1e-6)
    assert error.path_m == pytest.approx(2 * N * 0.3 * (1 / math.cos(a) - 1 / math.cos(b)), rel=1e-6)
    notes = specular_light(TracedScene(scene_of(wall, glass))).notes
    assert any("glass slab" in note and f"{1e3 * error.shift_m:.1f} mm" in note for note in notes)
    with pytest.raises(InputError, match=r"glass slab: .* mm of path .* limit .* 10 mm"):
        specular_light(TracedScene(scene_of(wall, glass, laser=Laser("flood", (0.1, 0, 0), 40.0))))
    narrow = scene_of(wall, slab(-1, 0.01), laser=Laser("flood", (0.01, 0, 0), 10.0), view=camera(9, 7, 5))
    assert any("glass slab" in note for note in specular_light(TracedScene(narrow)).notes)


def test_what_is_left_out_is_said():
    vertices, faces, _ = sphere(0.5, 4)
    ball = Surface(vertices - (0, 0, 3), faces, GOOD_MIRROR, name="chrome ball")
    light = specular_light(TracedScene(scene_of(ball)))
    assert any("chrome ball" in note for note in light.notes) and not len(light.samples.pixel)
    smooth = replace(ball, normals=vertices)
    assert any("chrome ball" in note for note in specular_light(TracedScene(scene_of(smooth))).notes)
    assert specular_light(TracedScene(scene_of(square((0, 0, -2), (0, 0, 1), 1, Material())))).notes == ()
    many = [square((0.3 * (i - 6), 0, -2), (0.01 * i, 0, 1), 0.1, GOOD_MIRROR) for i in range(70)]
    wide = Laser("flood", cone_deg=360.0)
    assert any("left out" in note for note in specular_light(TracedScene(scene_of(*many, laser=wide))).notes)


def test_planes_of_a_box():
    vertices, faces, uv = box((1, 2, 3))
    mirrors, _ = find_mirrors(TracedScene(scene_of(Surface(vertices - (0, 0, 9), faces, GOOD_MIRROR, uv=uv))))
    assert sorted(np.abs(mirrors.offset).tolist()) == pytest.approx([0.5, 0.5, 1, 1, 7.5, 10.5])


def test_many_panes_and_lenses_take_one_line_each_kind():
    """A scene with a hundred glass bulbs printed a line for each of them."""
    panes = [replace(slab(-1 - 0.1 * i, 0.01 * (1 + i % 3)), name=f"pane {i}") for i in range(12)]
    vertices, faces, _ = sphere(0.1, 2)
    bulbs = [Surface(vertices - (0, 0, 4 + i), faces, panes[0].material, name=f"bulb {i}") for i in range(104)]
    notes = check_slabs(TracedScene(scene_of(*panes, *bulbs)))
    assert len(notes) == 2
    assert (
        "104 solids" in notes[0]
        and "bends light as a lens does" in notes[0]
        and "bulb 7 and 96 more" in notes[0]
        and "bulb 8" not in notes[0]
    )
    worst = max(slab_error_m(TracedScene(scene_of(*panes))), key=lambda error: error.path_m)
    assert (
        "12 solids" in notes[1]
        and "crossed in a straight line" in notes[1]
        and f"{1e3 * worst.path_m:.1f} mm of path" in notes[1]
    )
