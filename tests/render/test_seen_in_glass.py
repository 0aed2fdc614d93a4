"""Light that faces of glass and coats reflect, against closed forms of the image method, Mitsuba's own path tracer, and
reciprocity."""

import math

import mitsuba as mi
import numpy as np
import pytest

from render import RenderSettings, render
from render.direct.integrator import direct_light
from render.scene.traced_scene import TracedScene
from render.specular.image_method import MAX_FACES, specular_light
from render.transient.samples import Samples
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import axis_frame, box, sphere

N, ALBEDO = 1.5, 0.5
PANE = Material("thindielectric", ior=N, name="pane")
SOLID = Material("dielectric", ior=N, name="solid glass")
MATT = Material(albedo=ALBEDO, name="matt")
LAMP = Laser("flood", cone_deg=360)
WIDTH, HEIGHT = 17, 13
SUBPIXELS = 8  # a side, of the closed forms' own rays


def square(centre, normal, half: float, material: Material) -> Surface:
    """A square around `centre`, perpendicular to `normal`."""
    frame = axis_frame(np.array(normal, float) / np.linalg.norm(normal))
    corners = np.array([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)])
    return Surface(corners @ frame.T + centre, [[0, 1, 2], [0, 2, 3]], material, name=material.name)


def slab(thickness_m: float, half: float = 1.5) -> Surface:
    """A slab of solid glass whose front lies in the plane x + z = -2, as `square` lays a pane."""
    vertices, faces, uv = box((2 * half, 2 * half, thickness_m))
    frame = axis_frame(np.array([1, 0, 1]) / math.sqrt(2))
    moved = (vertices - (0, 0, thickness_m / 2)) @ frame.T + (0, 0, -2)
    return Surface(moved, faces, SOLID, uv=uv, name=SOLID.name)


def view(fov_deg: float = 20.0, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """At the origin, looking along -z."""
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def fresnel(cosine):
    """Unpolarised reflectance of one face of glass, from Fresnel's equations."""
    inner = np.sqrt(1 - (1 - cosine**2) / N**2)
    s, p = (cosine - N * inner) / (cosine + N * inner), (N * cosine - inner) / (N * cosine + inner)
    return (s**2 + p**2) / 2


def of_pane(cosine):
    """Reflectance of a thin pane with all reflections inside."""
    one = fresnel(cosine)
    return 2 * one / (1 + one)


def specular(surfaces, laser: Laser = LAMP, camera: Camera | None = None, grid: int = SUBPIXELS) -> Samples:
    return specular_light(TracedScene(Scene("glass", tuple(surfaces), camera or view(), laser)), grid).samples


def sums(samples: Samples, bounces: int, pixels: int = WIDTH * HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and mean path of the samples of so many bounces, by pixel."""
    of = samples.bounces == bounces
    radiance = np.bincount(samples.pixel[of], samples.radiance[of], pixels)
    path = np.bincount(samples.pixel[of], (samples.radiance * samples.path_m)[of], pixels)
    return radiance, path / np.maximum(radiance, 1e-300)


def sub_rays(camera: Camera) -> np.ndarray:
    """Directions of SUBPIXELS^2 rays of every pixel, (H, W, SUBPIXELS^2, 3) float64."""
    places = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS
    row, column, y, x = np.meshgrid(
        np.arange(camera.height), np.arange(camera.width), places, places, indexing="ij"
    )  # fmt: skip
    return camera.rays(column + x, row + y).reshape(camera.height, camera.width, -1, 3)


def mirrored_wall(camera: Camera, behind_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the wall x = 3 m that rays see by a plane `behind_m` behind x + z = -2, the ways' lengths, and the
    cosines at that plane."""
    rays = sub_rays(camera)
    normal = np.array([1, 0, 1]) / math.sqrt(2)
    cosine = rays @ normal
    first = -(math.sqrt(2) + behind_m) / cosine
    place = first[..., None] * rays
    onward = rays - 2 * cosine[..., None] * normal
    second = (3 - place[..., 0]) / onward[..., 0]
    return place + second[..., None] * onward, first + second, np.abs(cosine)


def test_a_wall_seen_in_a_pane():
    """R f cos I / d^2 at the way by the pane and the way straight back; R^2 for light that comes by the pane, too."""
    camera = view()
    wall = square((3, 0, -2), (-1, 0, 0), 9, MATT)
    samples = specular((square((0, 0, -2), (1, 0, 1), 1.5, PANE), wall), camera=camera)
    point, way, cosine = mirrored_wall(camera)
    radiance, back = lit_by_lamp(camera, point)
    once = of_pane(cosine) * radiance
    got, path = sums(samples, 2)
    assert np.abs(got / once.mean(axis=-1).ravel() - 1).max() < 2e-4
    assert np.abs(path - ((once * (way + back)).sum(axis=-1) / once.sum(axis=-1)).ravel()).max() < 2e-4
    # the image of the wall is a frontal one at 5 m
    twice = of_pane(cosine) ** 2 * ALBEDO / math.pi * LAMP.intensity(camera).flat[0] * 5 / way**3
    got, path = sums(samples, 3)
    assert np.abs(got / twice.mean(axis=-1).ravel() - 1).max() < 2e-4
    assert np.abs(path - ((twice * 2 * way).sum(axis=-1) / twice.sum(axis=-1)).ravel()).max() < 2e-4
    assert set(samples.bounces) == {2, 3}


@pytest.mark.parametrize("material", [PANE, Material("plastic", albedo=0.4, ior=N, name="coat")])
def test_a_wall_lit_by_way_of_a_pane_or_a_coat(material: Material):
    """The pixel sees the wall itself: albedo/pi R I cos / |x - L'|^2 at path |x| + |x - L'|."""
    camera = view(30.0)
    mirror, wall = square((1, 0, -2), (-1, 0, 0), 5, material), square((0, 0, -3), (0, 0, 1), 0.9, MATT)
    got, path = sums(specular((mirror, wall), camera=camera), 2)
    rays = sub_rays(camera)
    point = -3 * rays / rays[..., 2:]
    way = point - (2, 0, 0)
    leg = np.linalg.norm(way, axis=-1)
    reflectance = (of_pane if material is PANE else fresnel)(np.abs(way[..., 0]) / leg)
    want = reflectance * ALBEDO / math.pi * LAMP.intensity(camera).flat[0] * 3 / leg**3
    inner = (np.abs(point[..., :2]) < 0.9).all(axis=(-1, -2)).ravel()
    assert inner.sum() > 50 and np.abs(got / want.mean(axis=-1).ravel() - 1)[inner].max() < 2e-4
    mean = ((want * (np.linalg.norm(point, axis=-1) + leg)).sum(axis=-1) / want.sum(axis=-1)).ravel()
    assert np.abs(path - mean)[inner].max() < 3e-4


def through_a_coat(swapped: bool, narrow_deg: float, seed: int = 0) -> float:
    """Power that a lamp sends by way of a panel's coat and a wall, both at 45 degrees, into the camera's view.

    One end looks at a spot of the wall; the other, half a right angle wide, at the panel. Both look along -z.
    """
    panel = square((1, 0, -1), (-1, 0, 1), 1.2, Material("plastic", albedo=0.0, ior=N, name="coat"))
    wall = square((-1, 0, -1), (1, 0, 1), 1.2, MATT)
    at_wall, at_panel, wide_deg = np.array([-1, 0.1, 0.5]), np.array([1, 0, 0.4]), 45.0
    eye, lamp = (at_panel, at_wall) if swapped else (at_wall, at_panel)
    fov, cone = (wide_deg, narrow_deg) if swapped else (narrow_deg, wide_deg)
    camera = Camera.look_at(eye, eye - (0, 0, 1), fov_deg=fov, width=48, height=48)
    laser = Laser("flood", tuple(camera.rotation.T @ (lamp - eye)), cone)
    settings = RenderSettings(bounces=2, spp=512, grid=2, adaptive=False)
    light = render(Scene("coat", (panel, wall), camera, laser), settings, seed=seed)
    of = light.bounces == 2
    pixel = np.repeat(np.arange(48 * 48), np.diff(light.offsets))[of]
    cosine = camera.rays().reshape(-1, 3) @ camera.rotation[:, 2]
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(cone) / 2))
    return float((light.radiance[of] * cosine[pixel] ** 3).sum() / camera.focal_px**2 * solid_angle)


@pytest.mark.parametrize("narrow_deg", [8.0, 20.0])
def test_laser_and_camera_may_change_places_by_way_of_a_coat(narrow_deg: float):
    """One way round the image method finds the light, the other way round paths that meet the coat by chance. Those of
    a pilot miss a narrow spot, which sets no scale then: sums held a thousandth of its light."""
    there = through_a_coat(False, narrow_deg) * math.pi / 4  # a square's over a disk's, of the narrow end's spot
    back = np.array([through_a_coat(True, narrow_deg, seed) for seed in range(6)])
    error = back.std(ddof=1) / math.sqrt(len(back))
    assert error < 0.1 * there and abs(back.mean() - there) < 4 * error + 0.01 * there


def test_mitsuba_sees_the_same_in_a_pane():
    """The second route: a path tracer that picks reflection or transmission by chance, here under a steady lamp."""
    camera = view(20.0, 8, 8)
    surfaces = square((0, 0, -2), (1, 0, 1), 1.5, PANE), square((3, 0, -2), (-0.8, 0.3, 0.1), 9, MATT)
    got, _ = sums(specular(surfaces, camera=camera), 2, 64)
    radiance, halves = LAMP.intensity(camera).flat[0], []
    for seed in range(2):
        shapes = {f"shape {i}": _mesh(surface) for i, surface in enumerate(surfaces)}
        image = mi.render(mi.load_dict(_steady(camera, radiance) | shapes), seed=seed, spp=16384).numpy()
        halves.append(image.reshape(-1))
    mean, error = sum(halves) / 2, np.abs(halves[0] - halves[1]).mean() / 2 / math.sqrt(2 / math.pi)
    assert error < 0.02 * mean.mean()
    assert abs(got.sum() / mean.sum() - 1) < 4 * error / mean.mean() / 8
    assert np.abs(got - mean).max() < 5 * error


def _mesh(surface: Surface) -> dict:
    kind = surface.material.kind
    bsdf = {"type": kind, "int_ior": N, "ext_ior": 1.0} if kind == "thindielectric" else {
        "type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "uniform", "value": ALBEDO}},
    }  # fmt: skip
    mesh = mi.Mesh("mesh", len(surface.vertices), len(surface.faces), props=_props(bsdf))
    params = mi.traverse(mesh)
    params["vertex_positions"] = surface.vertices.ravel().astype(np.float32)
    params["faces"] = surface.faces.ravel().astype(np.uint32)
    params.update()
    return mesh


def _props(bsdf: dict) -> mi.Properties:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    return props


def _steady(camera: Camera, intensity: float) -> dict:
    to_world = np.eye(4)
    to_world[:3, :3] = camera.rotation * (-1, -1, 1)
    sensor = {
        "type": "perspective", "fov": 2 * math.degrees(math.atan(camera.width / 2 / camera.focal_px)),
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "luminance",
                 "rfilter": {"type": "box"}},
    }  # fmt: skip
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "uniform", "value": intensity}}
    return {"type": "scene", "integrator": {"type": "path", "max_depth": 3}, "sensor": sensor, "lamp": lamp}


def lit_by_lamp(camera: Camera, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of points of the wall x = 3 m that the lamp shines on directly, and their distances to it."""
    back = np.linalg.norm(point, axis=-1)
    return ALBEDO / math.pi * LAMP.intensity(camera).flat[0] * (point[..., 0] / back) / back**2, back


def test_a_wall_seen_in_both_faces_of_a_slab():
    """F at the front, F (1 - F)^2 at the back, later by n times the way inside, which is taken for a straight one."""
    camera, t = view(), 0.05
    samples = specular((slab(t), square((3, 0, -2), (-1, 0, 0), 9, MATT)), camera=camera)
    wanted, path = np.zeros(WIDTH * HEIGHT), np.zeros(WIDTH * HEIGHT)
    for behind in (0, t):
        point, way, cosine = mirrored_wall(camera, behind)
        radiance, back = lit_by_lamp(camera, point)
        radiance = radiance * fresnel(cosine) * (1 - fresnel(cosine)) ** (2 if behind else 0)
        way = way + back + (N - 1) * 2 * behind / cosine
        wanted += radiance.mean(axis=-1).ravel()
        path += (radiance * way).mean(axis=-1).ravel()
    got, mean = sums(samples, 2)
    assert np.abs(got / wanted - 1).max() < 3e-4
    assert np.abs(mean - path / wanted).max() < 6e-4  # rays go on a little off each face that they pass


def test_light_comes_and_goes_by_the_faces_of_a_slab():
    """Compare with (a + b)^2: there and back light goes by either face, and nothing else differs but their reflectances
    a and b."""
    camera = view(4.0)
    got, _ = sums(specular((slab(2e-3), square((3, 0, -2), (-1, 0, 0), 9, MATT)), camera=camera), 3)
    _, way, cosine = mirrored_wall(camera)
    faces = fresnel(cosine) * (1 + (1 - fresnel(cosine)) ** 2)
    want = faces**2 * ALBEDO / math.pi * LAMP.intensity(camera).flat[0] * 5 / way**3
    assert np.abs(got / want.mean(axis=-1).ravel() - 1).max() < 5e-3


def test_a_room_seen_in_a_ball_of_glass():
    """The outer face alone: what is reflected inside goes on bent, not straight."""
    camera, radius = view(6.0), 0.25
    vertices, faces, _ = sphere(radius, 6)
    ball = Surface(vertices - (0, 0, 2), faces, SOLID, normals=vertices / radius, name="ball")
    wall = square((0, 0, 4), (0, 0, -1), 60, MATT)  # behind the camera
    samples = specular((ball, wall), camera=camera)
    rays = sub_rays(camera)
    middle = np.array([0, 0, -2.0])
    half = rays @ middle
    way = half - np.sqrt(half**2 - (4 - radius**2))
    normal = (way[..., None] * rays - middle) / radius
    cosine = -(rays * normal).sum(axis=-1)
    onward = rays + 2 * cosine[..., None] * normal
    further = (4 - (way[..., None] * rays)[..., 2]) / onward[..., 2]
    point = way[..., None] * rays + further[..., None] * onward
    back = np.linalg.norm(point, axis=-1)
    radiance = ALBEDO / math.pi * LAMP.intensity(camera).flat[0] * 4 / back**3 * fresnel(cosine)
    got, path = sums(samples, 2)
    inner = (onward[..., 2] > 0.2).all(axis=-1).ravel() & (cosine > 0.5).all(axis=-1).ravel()
    assert inner.sum() > 50 and np.abs(got / radiance.mean(axis=-1).ravel() - 1)[inner].max() < 0.01
    mean = ((radiance * (way + further + back)).sum(axis=-1) / radiance.sum(axis=-1)).ravel()
    assert np.abs(path - mean)[inner].max() < 0.01


def test_a_scanning_laser_sees_the_room_by_way_of_a_window():
    """The beam that meets the pane lights what the pane shows to the same pixel: R^2, at twice the way."""
    camera = view()
    window, wall = square((0, 0, -2), (1, 0, 1), 1.5, PANE), square((3, 0, -2), (-1, 0, 0), 9, MATT)
    laser = Laser("scan")
    samples = specular((window, wall), laser, camera)
    _, way, cosine = mirrored_wall(camera)
    intensity = laser.intensity(camera).reshape(HEIGHT, WIDTH, 1)
    want = of_pane(cosine) ** 2 * ALBEDO / math.pi * intensity * 5 / way**3
    got, path = sums(samples, 3)
    assert set(samples.bounces) == {3}
    assert np.abs(got / want.mean(axis=-1).ravel() - 1).max() < 1e-3
    assert np.abs(path - 2 * (want * way).sum(axis=-1).ravel() / want.sum(axis=-1).ravel()).max() < 1e-3


def test_glass_reflects_no_more_than_it_lets_not_pass():
    """Add up what is seen in a pane and what is seen through it, a wall and one at its image: R + T = 1."""
    camera = view()
    mirrored = square((3, 0, -2), (-1, 0, 0), 9, MATT)
    behind = square((0, 0, -5), (0, 0, 1), 9, MATT)  # where the image of the other wall is
    window = square((0, 0, -2), (1, 0, 1), 1.5, PANE)
    by_pane, _ = sums(specular((window, mirrored), camera=camera), 3)
    pixels = np.arange(WIDTH * HEIGHT)
    through, bare = (
        np.bincount(s.pixel, s.radiance, len(pixels))
        for s in (
            direct_light(TracedScene(Scene("glass", surfaces, camera, LAMP)), pixels, SUBPIXELS).samples
            for surfaces in ((window, behind), (behind,))
        )
    )
    assert np.abs(np.sqrt(by_pane / bare) + np.sqrt(through / bare) - 1).max() < 1e-3


def test_bounces_limit_what_glass_reflects():
    surfaces = square((0, 0, -2), (1, 0, 1), 1.5, PANE), square((3, 0, -2), (-1, 0, 0), 9, MATT)
    scene = Scene("glass", surfaces, view(), LAMP)
    for most, wanted in ((1, set()), (2, {2}), (3, {2, 3})):
        found = specular_light(TracedScene(scene), 4, bounces=most).samples
        assert set(found.bounces) == wanted
        assert wanted <= set(render(scene, RenderSettings(bounces=most, grid=4, spp=4, ambient=False)).bounces)


def test_many_panes_in_a_row_are_limited_and_said():
    panes = [square((0, 0, -2 - 0.1 * i), (1, 0, 1), 1.5, PANE) for i in range(MAX_FACES + 2)]
    scene = Scene("glass", (*panes, square((3, 0, -2), (-1, 0, 0), 9, MATT)), view(), LAMP)
    light = specular_light(TracedScene(scene), 1)
    assert any(f"beyond the first {MAX_FACES} along a ray" in note for note in light.notes)
    scene = Scene("glass", (*panes[:MAX_FACES], scene.surfaces[-1]), view(), LAMP)
    assert not any("beyond the first" in note for note in specular_light(TracedScene(scene), 1).notes)
