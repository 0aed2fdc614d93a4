"""Glass that bends direct light, against closed forms: slab, prisms, ball lens. 0.5 % of energy, 0.2 mm of path."""

from __future__ import annotations

import math

import numpy as np
import pytest

from render.direct.integrator import centre_layers, direct_light
from render.engine import render
from render.scene.traced_scene import TracedScene
from render.settings import RenderSettings
from scenes import Camera, InputError, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere

N = 1.5
GLASS = Material("dielectric", ior=N, name="glass")
ALBEDO = 0.5
ENERGY, PATH_M = 5e-3, 2e-4
SIZE = 9  # pixels a side: the middle one looks along the axis


def wall(distance_m: float, half: float = 5.0) -> Surface:
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    return quad([(x, y, -distance_m) for x, y in corners])


def quad(corners: object) -> Surface:
    return Surface(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], Material(albedo=ALBEDO), name="wall")


def block(turn_deg: float, thickness_m: float, distance_m: float, material: Material = GLASS) -> Surface:
    """A wide slab whose middle is on the axis, turned about y."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    vertices, faces, _ = box()
    turned = np.asarray(vertices) * (1.5, 1.5, thickness_m / 2) @ np.array([(c, 0, s), (0, 1, 0), (-s, 0, c)]).T
    return Surface(turned + (0, 0, -distance_m), faces, material, name="slab")


def prism(corners_xz: object, height_m: float = 1.0) -> Surface:
    """A glass prism along y over three corners (x, z)."""
    corners = np.array(corners_xz, float)
    low, high = (np.insert(corners, 1, y, axis=1) for y in (-height_m, height_m))
    sides = [[i, j, 3 + j] for i, j in ((0, 1), (1, 2), (2, 0))] + [
        [i, 3 + j, 3 + i] for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    return Surface(np.concatenate((low, high)), [*sides, [0, 1, 2], [3, 5, 4]], GLASS, name="prism")


def scene_of(*surfaces: Surface, fov_deg: float = 1.0, laser: Laser | None = None, aside_deg: float = 0.0) -> Scene:
    toward = (math.sin(math.radians(aside_deg)), 0, -math.cos(math.radians(aside_deg)))
    view = Camera.look_at((0, 0, 0), toward, fov_deg=fov_deg, width=SIZE, height=SIZE)
    return Scene("refraction", surfaces, view, laser or Laser())


def seen(scene: Scene, pixel: int = SIZE * SIZE // 2, *, bent: bool = True) -> tuple[float, float, float]:
    """Radiance over albedo I / pi, mean path [m] and depth label [m] of a pixel."""
    world = TracedScene(scene).refracting(bent)
    samples = direct_light(world, np.arange(SIZE * SIZE), 4).samples
    light = samples.radiance[samples.pixel == pixel]
    path = (samples.path_m[samples.pixel == pixel] * light).sum() / light.sum()
    unit = ALBEDO / math.pi * scene.laser.intensity(scene.camera).flat[pixel]
    return light.sum() / unit, path, float(centre_layers(world).depth_m.flat[pixel])


def fresnel_transmission(a: float, b: float) -> float:
    """Unpolarised, from an angle of incidence and one of refraction (Fresnel's sine and tangent laws)."""
    if a == 0:
        return 1 - ((N - 1) / (N + 1)) ** 2
    return 1 - ((math.sin(a - b) / math.sin(a + b)) ** 2 + (math.tan(a - b) / math.tan(a + b)) ** 2) / 2


@pytest.mark.parametrize(("turn_deg", "thickness_m"), [(0, 0.05), (20, 0.05), (45, 0.05), (45, 0.3), (-60, 0.1)])
def test_slab(turn_deg: float, thickness_m: float) -> None:
    """Lateral shift t sin(a - b) / cos b, delay n t / cos b, astigmatic spreading of its two principal sections."""
    scene = scene_of(wall(2.0), block(turn_deg, thickness_m, 1.0))
    a = math.radians(abs(turn_deg))
    b = math.asin(math.sin(a) / N)
    inside = thickness_m / math.cos(b)
    shift, air = inside * math.sin(a - b), 2.0 - inside * math.cos(a - b)
    spread = (air + inside / N) * (air + inside * math.cos(a) ** 2 / (N * math.cos(b) ** 2))
    light, path, depth = seen(scene)
    assert light == pytest.approx(fresnel_transmission(a, b) ** 4 / spread, rel=ENERGY)
    assert path == pytest.approx(2 * (air + N * inside), abs=PATH_M)
    assert depth == pytest.approx(math.hypot(2.0, shift), abs=PATH_M)


def test_a_straight_line_is_off_by_what_the_slab_note_says() -> None:
    """The same slab crossed in a straight line: longer by 2 n t (1 / cos a - 1 / cos b) and by the shift's way."""
    scene = scene_of(wall(2.0), block(45, 0.3, 1.0))
    assert seen(scene, bent=False)[1] - seen(scene)[1] > 0.02


@pytest.mark.parametrize("aside_deg", [0.0, 12.0])
def test_prism_deviates(aside_deg: float) -> None:
    """Deviation i + i' - A; what of the bundle passes is narrowed by cos i' cos b / (cos b' cos i) in the plane."""
    apex, incidence = math.radians(40), math.radians(30 + aside_deg)
    # its front face is met at (0, -1), its normal turned by the incidence about y
    normal = np.array([math.sin(incidence), math.cos(incidence)])
    along = np.array([math.cos(incidence), -math.sin(incidence)])
    tip = np.array([0, -1.0]) + 0.15 * along
    back = -along * math.cos(apex) - normal * math.sin(apex)
    scene = scene_of(prism([tip, tip - 0.4 * along, tip + 0.4 * back]), wall(3.0))
    b = math.asin(math.sin(incidence) / N)
    b_out = apex - b
    out = math.asin(N * math.sin(b_out))
    inside = 0.15 * math.sin(apex) / math.cos(b_out)
    # directions (x, z): the way in the glass leans from the ray towards the base, away from the tip
    bent = incidence - b
    left_at = np.array([0, -1.0]) + inside * np.array([-math.sin(bent), -math.cos(bent)])
    deviation = incidence + out - apex
    air = (3.0 + left_at[1]) / math.cos(deviation)
    end = left_at + air * np.array([-math.sin(deviation), -math.cos(deviation)])
    # width and divergence of a thin bundle in the plane: a face scales widths by cos b / cos i, angles by the inverse
    width, angle = math.cos(b) / math.cos(incidence), math.cos(incidence) / (N * math.cos(b))
    width = (width + inside * angle) * math.cos(out) / math.cos(b_out)
    angle *= N * math.cos(b_out) / math.cos(out)
    in_plane, across = width + air * angle, 1.0 + inside / N + air
    lost = fresnel_transmission(incidence, b) * fresnel_transmission(out, b_out)
    light, path, depth = seen(scene)
    assert depth == pytest.approx(math.hypot(*end), abs=PATH_M)
    assert path == pytest.approx(2 * (1.0 + N * inside + air), abs=PATH_M)
    assert light == pytest.approx(lost**2 * math.cos(deviation) / (in_plane * across), rel=ENERGY)


def test_total_reflection_in_a_right_angled_prism() -> None:
    """In by one leg, totally reflected by the hypotenuse (45 degrees, beyond 41.8), out by the other: no loss there."""
    scene = scene_of(
        prism([(-0.1, -1.0), (0.1, -1.0), (-0.1, -1.2)]), quad([(-2, -1, -3), (-2, 1, -3), (-2, 1, 1), (-2, -1, 1)])
    )
    light, path, depth = seen(scene)
    inside, air = 0.2, 1.0 + 1.9
    assert light == pytest.approx(fresnel_transmission(0, 0) ** 4 / (air + inside / N) ** 2, rel=ENERGY)
    assert path == pytest.approx(2 * (air + N * inside), abs=PATH_M)
    assert depth == pytest.approx(math.hypot(2.0, 1.1), abs=PATH_M)


def ball(radius_m: float, distance_m: float) -> Surface:
    vertices, faces, _ = sphere(1.0, 6)
    vertices = np.asarray(vertices)
    # the mesh's corners are on the sphere: its faces are nearer by up to 4e-4 of the radius
    return Surface(radius_m * vertices + (0, 0, -distance_m), faces, GLASS, normals=vertices, name="ball")


@pytest.mark.parametrize("wall_m", [1.2, 3.0])
def test_ball_lens_magnifies_as_paraxial_optics_says(wall_m: float) -> None:
    """Before and behind the image: width r and angle t of a thin bundle go by n t' = t - (n - 1) r / R at each face."""
    radius, distance = 0.05, 1.0
    r = distance - radius
    inside = (1 - (N - 1) * r / radius) / N
    r += 2 * radius * inside
    angle = N * inside - (N - 1) * r / radius
    r += (wall_m - distance - radius) * angle
    light, path, depth = seen(scene_of(wall(wall_m), ball(radius, distance), fov_deg=0.05))
    assert light == pytest.approx(fresnel_transmission(0, 0) ** 4 / r**2, rel=ENERGY)
    assert path == pytest.approx(2 * (wall_m + (N - 1) * 2 * radius), abs=PATH_M)
    assert depth == pytest.approx(wall_m, abs=PATH_M)


def meridional(angle: float, radius: float, distance: float, wall_m: float) -> tuple[float, float, float]:
    """Where a ray at `angle` off the axis meets the wall behind a ball [m], its optical path, and its transmission."""
    a = math.asin(distance * math.sin(angle) / radius)
    b = math.asin(math.sin(a) / N)
    to_ball = distance * math.cos(angle) - radius * math.cos(a)
    inside = 2 * radius * math.cos(b)
    turned = angle - 2 * (a - b)  # of the way out
    # the second point is at the angle pi - 2 b round the centre from the first
    first = math.pi - (a - angle)  # from the axis, seen from the centre, measured from the wall's side
    second = first - (math.pi - 2 * b)
    height, ahead = radius * math.sin(second), distance + radius * math.cos(second)
    air = (wall_m - ahead) / math.cos(turned)
    return height + air * math.sin(turned), to_ball + N * inside + air, fresnel_transmission(a, b) ** 2


@pytest.mark.parametrize("angle_deg", [0.7, 1.5])
def test_ball_lens_off_its_axis(angle_deg: float) -> None:
    """Exact rays in the plane of the axis: light is I sin t dt / (r dr), times the transmission of both ways."""
    lens, wall_m, step = (0.05, 1.0), 1.3, 1e-5
    angle = math.radians(angle_deg)
    height, path_m, passed = meridional(angle, *lens, wall_m)
    rate = (meridional(angle + step, *lens, wall_m)[0] - meridional(angle - step, *lens, wall_m)[0]) / (2 * step)
    light, path, depth = seen(scene_of(wall(wall_m), ball(*lens), fov_deg=0.05, aside_deg=angle_deg))
    assert light == pytest.approx(passed**2 * math.sin(angle) / abs(height * rate), rel=ENERGY)
    assert path == pytest.approx(2 * path_m, abs=PATH_M)
    assert depth == pytest.approx(math.hypot(height, wall_m), abs=PATH_M)


def test_a_surface_inside_glass() -> None:
    """Paint in a block, 0.3 m deep: what leaves glass is spread over n^2 as much solid angle."""
    scene = scene_of(block(0, 0.6, 1.3), wall(1.3))
    light, path, _ = seen(scene)
    assert light == pytest.approx(fresnel_transmission(0, 0) ** 2 / (N**2 * (1.0 + 0.3 / N) ** 2), rel=ENERGY)
    assert path == pytest.approx(2 * (1.0 + 0.3 * N), abs=PATH_M)


def test_pixels_beside_the_glass_do_not_change() -> None:
    """Their samples have the same bytes, bent or straight; so have those of a scene without glass."""
    scene = scene_of(wall(2.0), prism([(0.5, -1), (2, -1), (2, -1.5)]), fov_deg=60.0)
    straight, bent = (
        direct_light(TracedScene(scene).refracting(way), np.arange(SIZE * SIZE), 2).samples for way in (False, True)
    )
    beside = [np.isin(samples.pixel % SIZE, (0, 1, 2, 3, 4)) for samples in (straight, bent)]
    assert beside[0].sum() > 40 and not np.array_equal(straight.path_m, bent.path_m)
    for one, other in zip(straight, bent, strict=True):
        assert np.array_equal(one[beside[0]], other[beside[1]])


def test_a_cone_narrower_than_the_view_is_dark_beyond_its_rays() -> None:
    """What is lit is told by the way that a ray starts, not by where it ends."""
    scene = scene_of(wall(2.0), block(45, 0.3, 1.0), fov_deg=10.0, laser=Laser("flood", cone_deg=4.0))
    samples = direct_light(TracedScene(scene).refracting(True), np.arange(SIZE * SIZE), 8).samples
    light = np.bincount(samples.pixel, samples.radiance, minlength=SIZE * SIZE).reshape(SIZE, SIZE)
    assert light[4, 4] > 0 and light[4, :2].sum() == light[4, -2:].sum() == light[0].sum() == 0
    assert light[4, 2] == pytest.approx(light[4, 6], rel=0.1)


@pytest.mark.parametrize("mode", ["line", "scan"])
def test_a_scanned_laser_sends_its_light_along_the_pixel(mode: str) -> None:
    scene = scene_of(wall(2.0), block(45, 0.3, 1.0), laser=Laser(mode))
    flood = scene_of(wall(2.0), block(45, 0.3, 1.0))
    assert seen(scene)[:2] == pytest.approx(seen(flood)[:2], rel=1e-6)


# --- the plan -------------------------------------------------------------------------------------------------------

FORCED = {"bounces": 1, "grid": 2, "ambient": False}


@pytest.mark.parametrize(("asked", "way"), [(None, "bent"), ("bent", "bent"), ("straight", "straight")])
def test_the_plan_bends_light_where_there_is_thick_glass(asked: str | None, way: str) -> None:
    scene = scene_of(wall(2.0), block(45, 0.3, 1.0))
    transient = render(scene, RenderSettings(**FORCED, refraction=asked))
    plan = transient.meta["plan"]
    assert plan["refraction"] == way
    assert any("is refracted" in reason for reason in plan["reasons"]) == (way == "bent")
    assert transient.depth_m[4, 4] == pytest.approx(seen(scene, bent=way == "bent")[2], abs=1e-6)


def test_a_displaced_laser_keeps_straight_lines() -> None:
    pane = block(0, 0.004, 1.0)
    scene = scene_of(wall(2.0), pane, laser=Laser("flood", (0.05, 0, 0), 20.0))
    assert render(scene, RenderSettings(**FORCED)).meta["plan"]["refraction"] == "straight"
    with pytest.raises(InputError, match="displaced: leave it straight"):
        render(scene, RenderSettings(**FORCED, refraction="bent"))


def test_scenes_without_thick_glass_are_straight() -> None:
    pane = block(0, 0.004, 1.0, Material("thindielectric", ior=N))
    plan = render(scene_of(wall(2.0), pane), RenderSettings(**FORCED)).meta["plan"]
    assert plan["refraction"] == "straight" and not any("thick glass" in reason for reason in plan["reasons"])
    with pytest.raises(InputError, match="refraction 'curved', expected straight or bent"):
        RenderSettings(refraction="curved")
