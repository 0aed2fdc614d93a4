"""The nouns: what each constructor refuses, the camera's geometry, the laser's profile, the scene's digest."""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest

from scenes import Ambient, Camera, InputError, Laser, Material, Scene, Surface, Texture, model

VERTICES = ((0.0, 0, 0), (1, 0, 0), (0, 1, 0))
FACES = ((0, 1, 2),)
UV = ((0.0, 0), (1, 0), (0, 1))
NAN, INF = math.nan, math.inf


def texture(value: float = 0.5, name: str = "t") -> Texture:
    return Texture(np.full((2, 3), value), name)


def camera(**changes) -> Camera:
    return Camera(**{"pose": np.eye(4), "fov_deg": 60.0, "width": 8, "height": 6} | changes)


def surface(**changes) -> Surface:
    return Surface(**{"vertices": VERTICES, "faces": FACES, "uv": UV} | changes)


def scene(**changes) -> Scene:
    return Scene(**{"name": "s", "surfaces": (surface(),), "camera": camera()} | changes)


def refuses(make, words: str) -> None:
    """`make()` must raise an InputError of one line that contains `words`."""
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    assert words in message and message and "\n" not in message


# --- What is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((2, 2, 3)), "shape (2, 2, 3)"),
        (np.zeros((0, 2)), "shape (0, 2)"),
        ([[NAN]], "NaN"),
        ([[INF]], "infinite"),
        ([[-0.5]], "negative value -0.5"),
    ],
)
def test_texture_refuses(image, words):
    refuses(lambda: Texture(image, "wall paper"), words)
    refuses(lambda: Texture(image, "wall paper"), "wall paper")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "velvet"}, "'velvet'"),
        ({"albedo": 1.2}, "albedo"),
        ({"albedo": -0.1}, "albedo"),
        ({"albedo": NAN}, "albedo"),
        ({"albedo": texture(1.5)}, "albedo"),
        ({"specular": 2.0}, "specular"),
        ({"opacity": -1.0}, "opacity"),
        ({"opacity": texture(3.0)}, "opacity"),
        ({"kind": "dielectric", "opacity": 0.9}, "glass has opacity 1 here, cut its mesh instead"),
        ({"kind": "thindielectric", "opacity": texture()}, "glass has opacity 1"),
        ({"roughness": 0.0}, "roughness"),
        ({"distribution": "hills"}, "distribution 'hills' is unknown, expected one of ggx, beckmann"),
        ({"roughness": 1.5}, "roughness"),
        ({"roughness": NAN}, "roughness"),
        ({"ior": 1.0}, "index of refraction"),
        ({"ior": 6.0}, "index of refraction"),
        ({"eta": -1.0}, "eta"),
        ({"eta": INF}, "eta"),
        ({"k": -1.0}, "conductor k"),
        ({"k": NAN}, "k nan"),
    ],
)
def test_material_refuses(changes, words):
    refuses(lambda: Material(**changes, name="velvet"), words)
    refuses(lambda: Material(**changes, name="velvet"), "material velvet")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vertices": ((0.0, 0), (1, 0))}, "vertices: shape (2, 2)"),
        ({"vertices": "abc"}, "vertices: not an array of numbers"),
        ({"vertices": np.zeros((1, 3, 3))}, "tables of three columns"),
        ({"faces": ((0, 1, 2, 3),)}, "faces: shape (1, 4)"),
        ({"faces": np.zeros((0, 3), int)}, "no faces"),
        ({"vertices": np.zeros((0, 3)), "uv": None}, "no faces"),
        ({"vertices": ((NAN, 0, 0), (1, 0, 0), (0, 1, 0))}, "1 of 3 vertices are NaN or infinite"),
        ({"vertices": ((INF, 0, 0), (1, NAN, 0), (0, 1, 0))}, "2 of 3 vertices"),
        ({"faces": ((0, 1, 3),)}, "vertex 3, expected 0 to 2"),
        ({"faces": ((0, 1, -1),)}, "expected 0 to 2"),
        ({"uv": ((0.0, 0),)}, "1 uv for 3 vertices"),
        ({"uv": ((0.0, 0), (1, NAN), (0, 1))}, "uv hold NaN"),
        ({"uv": VERTICES}, "uv: shape (3, 3)"),
        ({"normals": ((0.0, 0, 1),)}, "1 normals for 3 vertices"),
        ({"normals": ((0.0, 0, INF),) * 3}, "normals hold NaN"),
        ({"normals": np.zeros((3, 3))}, "3 of 3 normals have no length, that of vertex 0 0"),
        ({"normals": ((0.0, 0, 1), (0, 0, 1), (0, 0, 1e-30))}, "1 of 3 normals have no length, that of vertex 2 1e-30"),
        ({"material": Material(albedo=texture()), "uv": None}, "no uv"),
        ({"material": Material(opacity=texture()), "uv": None}, "no uv"),
        ({"emission": -1.0}, "emission"),
        ({"emission": NAN}, "emission"),
    ],
)
def test_surface_refuses(changes, words):
    refuses(lambda: surface(**changes, name="chair"), words)
    refuses(lambda: surface(**changes, name="chair"), "mesh chair")


def test_a_vertex_of_no_face_needs_no_normal():
    points, normals = (*VERTICES, (5.0, 5, 5)), ((0.0, 0, 1),) * 3 + ((0.0, 0, 0),)
    assert surface(vertices=points, normals=normals, uv=None, material=Material()).normals[3].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pose": np.eye(3)}, "camera pose: shape (3, 3)"),
        ({"pose": np.full((4, 4), NAN)}, "4x4 finite numbers"),
        ({"pose": np.stack([np.eye(4)] * 2)}, "4x4 finite numbers"),
        ({"pose": np.diag((2.0, 2, 2, 1))}, "not a rotation"),
        ({"pose": np.diag((-1.0, 1, 1, 1))}, "not a rotation"),
        ({"pose": np.diag((1.0, 1, 1, 2))}, "last row"),
        ({"width": 0}, "camera width 0"),
        ({"width": 2.5}, "camera width 2.5"),
        ({"height": -4}, "camera height -4"),
        ({"height": 20000}, "camera height 20000"),
        ({"fov_deg": 0.0}, "fov 0"),
        ({"fov_deg": 171.0}, "fov 171"),
        ({"fov_deg": NAN}, "fov nan"),
    ],
)
def test_camera_refuses(changes, words):
    refuses(lambda: camera(**changes), words)


@pytest.mark.parametrize(
    ("origin", "target", "up"),
    [((0, 0, 0), (0, 0, 0), (0, 1, 0)), ((0, 0, 0), (0, 5, 0), (0, 1, 0)), ((0, 0, 0), (0, 0, 5), (0, 0, 0))],
)
def test_look_at_refuses_a_view_without_direction(origin, target, up):
    refuses(lambda: Camera.look_at(origin, target, fov_deg=60, width=4, height=4, up=up), "cannot look at")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mode": "sweep"}, "'sweep'"),
        ({"baseline_m": (0.1, 0.2)}, "is not three finite numbers"),
        ({"baseline_m": (0.1, NAN, 0)}, "is not three finite numbers"),
        ({"baseline_m": (0, 1e308, 0)}, "outside -1e+07 to 1e+07 in a coordinate"),
        ({"cone_deg": 0.0}, "outside (0, 360]"),
        ({"cone_deg": 1e-7}, "laser cone 1e-07 degrees is outside (0, 360], 1e-06 at least"),
        ({"cone_deg": 361.0}, "outside (0, 360]"),
        ({"cone_deg": NAN}, "laser cone nan is not a finite number"),
        ({"mode": "scan", "cone_deg": 10.0}, "a cone is for flood only"),
        ({"mode": "line", "cone_deg": 10.0}, "a cone is for flood only"),
    ],
)
def test_laser_refuses(changes, words):
    refuses(lambda: Laser(**changes), words)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"radiance": -1.0}, "negative"),
        ({"radiance": INF}, "ambient radiance"),
        ({"radiance": 1.0, "environment": texture()}, "not both"),
        ({"pose": np.diag((1.0, 1, -1, 1))}, "environment pose"),
    ],
)
def test_ambient_refuses(changes, words):
    refuses(lambda: Ambient(**changes), words)


def test_scene_refuses_to_be_empty():
    refuses(lambda: scene(surfaces=()), "no surfaces")


def test_arrays_are_copied_and_read_only():
    mine = np.array(VERTICES)
    made = surface(vertices=mine)
    mine[0] = 9
    assert made.vertices[0].tolist() == [0, 0, 0]
    for array in (made.vertices, made.faces, made.uv, camera().pose, texture().image):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_glass_and_cut_outs_let_light_through():
    assert Material("dielectric").is_glass and Material("thindielectric").lets_light_through
    assert not Material("diffuse").lets_light_through and not Material("plastic").is_glass
    holes = Material(opacity=Texture([[1.0, 0.0]], "leaf"))
    assert holes.lets_light_through and not holes.is_glass
    assert not Material(opacity=Texture([[1.0, 1.0]], "solid")).lets_light_through
    assert Material(opacity=0.5).lets_light_through


# --- Camera ----------------------------------------------------------------------------------------------------------


def test_rays_of_a_camera_in_the_world_frame():
    # 2 x 2 pixels at 90 degrees: focal length 1 pixel, centres half a pixel off the axis.
    rays = camera(fov_deg=90.0, width=2, height=2).rays()
    length = math.sqrt(1.5)
    assert rays.shape == (2, 2, 3)
    assert rays[0, 0] == pytest.approx((-0.5 / length, -0.5 / length, 1 / length))
    assert rays[1, 0] == pytest.approx((-0.5 / length, 0.5 / length, 1 / length))


def test_look_at_puts_up_above_and_right_on_the_right():
    view = Camera.look_at((1, 2, 3), (1, 2, -4), fov_deg=90, width=4, height=2)
    assert view.origin.tolist() == [1, 2, 3]
    assert view.rotation == pytest.approx(np.array(((1.0, 0, 0), (0, -1, 0), (0, 0, -1))))
    rays = view.rays()
    assert rays[0, 0, 0] < 0 < rays[0, -1, 0] and rays[-1, 0, 1] < 0 < rays[0, 0, 1]
    corner = view.rays(np.array([4.0]), np.array([0.0]))[0]
    assert corner == pytest.approx(np.array((2, 1, -2)) / 3)


def test_a_turned_camera_turns_its_rays():
    turned = Camera.look_at((0, 0, 0), (1, 0, 0), fov_deg=60, width=3, height=3)
    assert turned.rays()[1, 1] == pytest.approx((1, 0, 0))
    assert np.linalg.norm(turned.rays(), axis=-1) == pytest.approx(1)


def test_focal_length_and_resizing():
    view = camera(fov_deg=90.0, width=128, height=96)
    assert view.focal_px == pytest.approx(64)
    assert view.resized() is view
    sizes = [(r.width, r.height) for r in (view.resized(64), view.resized(height=48), view.resized(10, 20))]
    assert sizes == [(64, 48), (64, 48), (10, 20)]
    assert view.resized(1, None).height == 1
    assert view.resized(64).fov_deg == 90.0
    refuses(lambda: view.resized(0), "camera width 0")


def image_solid_angle(view: Camera) -> float:
    """A rectangle of half sides a, b at distance 1 on axis: 4 asin(a b / sqrt((1 + a^2) (1 + b^2)))."""
    a, b = view.width / 2 / view.focal_px, view.height / 2 / view.focal_px
    return 4 * math.asin(a * b / math.sqrt((1 + a * a) * (1 + b * b)))


@pytest.mark.parametrize("fov_deg", [1.0, 60.0, 150.0])
def test_pixel_solid_angles_add_up_to_the_image(fov_deg):
    view = camera(fov_deg=fov_deg, width=17, height=10)
    solid_angle = view.pixel_solid_angle()
    assert solid_angle.shape == (10, 17) and solid_angle.min() > 0
    assert solid_angle.sum() == pytest.approx(image_solid_angle(view), rel=1e-10)


def test_pixel_solid_angle_falls_with_the_cube_of_the_cosine():
    view = camera(fov_deg=80.0, width=400, height=300)
    cosine = view.rays()[..., 2]
    assert np.allclose(view.pixel_solid_angle(), cosine**3 / view.focal_px**2, rtol=1e-4, atol=0)


# --- Laser -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cone_deg", [None, 1e-6, 20.0, 90.0, 360.0])
def test_flood_intensity_integrates_to_one_over_its_cone(cone_deg):
    view, laser = camera(), Laser("flood", cone_deg=cone_deg)
    # rings of equal steps in angle: sum of intensity x 2 pi sin(angle) d(angle), exact to the midpoint rule
    half = laser.half_angle(view)
    assert math.cos(half) == laser.cos_half_angle(view)
    angle = (np.arange(2000) + 0.5) / 2000 * half
    solid_angle = (2 * math.pi * np.sin(angle)).sum() * half / 2000
    intensity = laser.intensity(view)
    assert intensity.shape == (6, 8) and np.ptp(intensity) == 0
    assert intensity[0, 0] * solid_angle == pytest.approx(1, rel=1e-5)


def test_the_default_cone_is_the_smallest_that_holds_the_image():
    view = camera()
    corner = view.rays(np.array([0.0]), np.array([0.0]))[0]
    assert Laser().cos_half_angle(view) == pytest.approx(corner[2])
    assert Laser().intensity(view)[0, 0] * image_solid_angle(view) < 1
    assert Laser(cone_deg=60.0).cos_half_angle(view) == pytest.approx(math.cos(math.radians(30)))


def test_line_and_scan_intensity_integrate_to_one_over_row_and_pixel():
    view = camera()
    solid_angle = view.pixel_solid_angle()
    assert (Laser("line").intensity(view) * solid_angle).sum(axis=1) == pytest.approx(1)
    assert Laser("scan").intensity(view) * solid_angle == pytest.approx(1)
    assert np.ptp(Laser("line").intensity(view), axis=1) == pytest.approx(0)


def test_laser_position_follows_the_camera_frame():
    view = Camera.look_at((0, 1, 0), (0, 1, -1), fov_deg=60, width=4, height=3)
    assert Laser().is_colocated and Laser().position(view) == pytest.approx(view.origin)
    displaced = Laser(baseline_m=(0.1, 0.2, 0.3))
    assert not displaced.is_colocated
    assert displaced.position(view) == pytest.approx((0.1, 0.8, -0.3))


# --- Scene -----------------------------------------------------------------------------------------------------------


def test_scene_counts_bounds_and_ambient():
    far = surface(vertices=((5.0, 5, 5), (6, 5, 5), (5, 7, 5)))
    both = scene(surfaces=[surface(), far])
    assert both.triangles == 2 and isinstance(both.surfaces, tuple)
    low, high = both.bounds()
    assert low.tolist() == [0, 0, 0] and high.tolist() == [6, 7, 5]
    assert not both.has_ambient
    assert scene(ambient=Ambient(radiance=0.1)).has_ambient
    assert scene(ambient=Ambient(environment=texture())).has_ambient
    assert scene(surfaces=(surface(emission=0.1),)).has_ambient


DIGEST_CHANGES = {
    "vertices": scene(surfaces=(surface(vertices=((0.0, 0, 1e-9), *VERTICES[1:])),)),
    "faces": scene(surfaces=(surface(faces=((0, 2, 1),)),)),
    "uv": scene(surfaces=(surface(uv=None),)),
    "uv value": scene(surfaces=(surface(uv=((0.0, 0), (1, 0), (0, 2))),)),
    "normals": scene(surfaces=(surface(normals=((0.0, 0, 1),) * 3),)),
    "emission": scene(surfaces=(surface(emission=0.5),)),
    "one more surface": scene(surfaces=(surface(), surface())),
    "kind": scene(surfaces=(surface(material=Material("plastic")),)),
    "albedo": scene(surfaces=(surface(material=Material(albedo=0.4)),)),
    "textured albedo": scene(surfaces=(surface(material=Material(albedo=texture())),)),
    "roughness": scene(surfaces=(surface(material=Material(roughness=0.2)),)),
    "distribution": scene(surfaces=(surface(material=Material(distribution="beckmann")),)),
    "specular": scene(surfaces=(surface(material=Material(specular=0.2)),)),
    "ior": scene(surfaces=(surface(material=Material(ior=1.3)),)),
    "eta": scene(surfaces=(surface(material=Material(eta=1.3)),)),
    "k": scene(surfaces=(surface(material=Material(k=1.3)),)),
    "opacity": scene(surfaces=(surface(material=Material(opacity=0.3)),)),
    "pose": scene(camera=Camera.look_at((0, 0, 0), (1, 0, 0), fov_deg=60, width=8, height=6)),
    "fov": scene(camera=camera(fov_deg=61.0)),
    "width": scene(camera=camera(width=9)),
    "height": scene(camera=camera(height=7)),
    "laser mode": scene(laser=Laser("scan")),
    "baseline": scene(laser=Laser(baseline_m=(0, 0, 0.1))),
    "cone": scene(laser=Laser(cone_deg=30.0)),
    "ambient": scene(ambient=Ambient(radiance=0.1)),
    "environment": scene(ambient=Ambient(environment=texture())),
    "other environment": scene(ambient=Ambient(environment=texture(0.25))),
    "environment pose": scene(ambient=Ambient(pose=np.diag((-1.0, 1, -1, 1)))),
}


def test_digest_changes_with_every_field():
    digests = [scene().digest(), *(changed.digest() for changed in DIGEST_CHANGES.values())]
    assert len(set(digests)) == len(digests)
    assert all(len(digest) == 64 for digest in digests)


def test_digest_is_of_before_there_were_distributions():
    """A field that came later does not change what was hashed before, however its value was spelled."""
    spelled = Material(distribution="".join(("g", "gx")))
    assert scene(surfaces=(surface(material=spelled),)).digest() == scene().digest()
    older = hashlib.sha256(b"Material")
    for value in ("diffuse", 0.5, 0.1, 1.0, 1.5, 0.0, 1.0, 1.0):
        older.update(hashlib.sha256(type(value).__name__.encode() + repr(value).encode()).digest())
    assert model.part_digest(Material()) == older.digest()


def test_digest_is_repeatable_and_ignores_names_and_notes():
    named = surface(name="other", material=Material(name="other"))
    assert scene().digest() == scene(name="x", surfaces=(named,), notes=("read from a file",)).digest()
    textured = [surface(material=Material(albedo=texture(name=name))) for name in ("a", "b")]
    assert len({scene(surfaces=(s,)).digest() for s in textured}) == 1
    assert replace(scene(), notes=("n",)).notes == ("n",)
