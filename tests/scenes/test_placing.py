"""What a user says of a scene beyond its file: unit, upward axis, camera, floor and wall; and constructs of others."""

import math
from pathlib import Path

import numpy as np
import pytest
import xml_files

from scenes import InputError
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.library.catalog import load_scene
from scenes.optics.blackbody import planck_w_per_m2_nm, seen_radiance_w_per_m2_sr_nm, sunlit_sky_w_per_m2_sr_nm
from scenes.placing import Placing, scaled

# A tetrahedron whose tip lies along z, half a unit tall.
TIP = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.2 0.5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.fixture
def tip(tmp_path) -> Path:
    path = tmp_path / "tip.obj"
    path.write_text(TIP)
    return path


@pytest.mark.parametrize(("up", "height"), [("x", 1.0), ("y", 1.0), ("z", 0.5)])
def test_the_axis_that_is_said_to_be_up_is(tip, up, height):
    """The body is as tall as the file is along that axis, stays right-handed and stands on the floor."""
    surface = load_mesh(tip, placing=Placing(up=up, bare=True)).surfaces[0]
    assert np.ptp(surface.vertices[:, 1]) == pytest.approx(height) and surface.vertices[:, 1].min() == 0
    corners = surface.vertices[surface.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(0.5 / 6)


def test_a_stated_scale_is_taken_without_a_guess(tip):
    scene = load_mesh(tip, placing=Placing(scale=0.01))
    assert np.ptp(scene.surfaces[0].vertices[:, 0]) == pytest.approx(0.01)
    assert not any("warning" in note for note in scene.notes)


def test_bare_leaves_the_mesh_alone_and_a_camera_stands_where_it_is_put(tip):
    placing = Placing(origin=(0.0, 3.0, 0.1), target=(0.0, 0.0, 0.0), fov_deg=25.0, bare=True)
    scene = load_mesh(tip, placing=placing)
    assert len(scene.surfaces) == 1 and scene.camera.fov_deg == 25
    assert np.allclose(scene.camera.origin, (0, 3, 0.1))
    with pytest.raises(InputError, match="use --bare"):
        load_mesh(tip, placing=Placing(origin=(0.0, 1.0, -9.0), target=(0.0, 0.0, 0.0)))


@pytest.mark.parametrize(("height_m", "up", "words"), [(5.0, -1, "down: -z"), (-5.0, 1, "up: +z")])
def test_a_view_straight_down_or_up_keeps_right_and_front(tip, height_m, up, words):
    """It is the limit of upright views from the front (+z) that go over the top, or under it: +x is on the right."""
    placing = Placing(origin=(0.0, height_m, 0.0), target=(0.0, 0.0, 0.0), bare=True)
    scene = load_mesh(tip, placing=placing)
    right, down, forward = scene.camera.rotation.T
    assert right == pytest.approx((1, 0, 0)) and down == pytest.approx((0, 0, -up))
    assert forward == pytest.approx((0, -math.copysign(1, height_m), 0))
    assert any(f"straight {words} is up in the image" in note for note in scene.notes)
    near = load_mesh(tip, placing=Placing(origin=(0.0, height_m, 1e-4), target=(0.0, 0.0, 0.0), bare=True))
    assert near.camera.rotation == pytest.approx(scene.camera.rotation, abs=1e-4)
    assert not any("straight" in note for note in near.notes)


def test_a_view_from_above_needs_no_target_and_may_have_a_floor(tip):
    """The middle of a mesh in single precision lies beside its axis by some rounding, which turns no picture."""
    for origin in ((0.0, 3.0, 0.0), (1e-7, 3.0, -1e-7)):
        scene = load_mesh(tip, placing=Placing(origin=origin))
        assert [surface.name for surface in scene.surfaces] == ["tip", "floor", "wall"]
        assert scene.camera.rotation[:, 0] == pytest.approx((1, 0, 0), abs=1e-6)


def test_a_scene_seen_from_above_keeps_its_notes():
    scene = load_scene("tabletop/spikes", placing=Placing(origin=(0.0, 50.0, 0.0), target=(0.0, 0.0, 0.0)))
    assert len(scene.notes) == len(load_scene("tabletop/spikes").notes) + 1
    assert scene.notes[-1] == "the camera looks straight down: -z is up in the image, +x on its right"


def test_fields_of_a_placing_are_keywords_too(tip):
    """They come on top of those of a placing that is given."""
    one = load_scene(str(tip), scale=0.01, up="z", bare=True)
    other = load_scene(str(tip), placing=Placing(scale=0.01, bare=True), up="z")
    assert one.digest() == other.digest() == load_scene(str(tip), placing=Placing("z", 0.01, bare=True)).digest()
    assert load_scene("plane", fov_deg=20).camera.fov_deg == 20


SHEET = "v 0 0 0\nv 0 0 1\nv 1 0 1\nv 1 0 0\nf 1 2 3 4\n"


@pytest.mark.parametrize(
    ("text", "scale", "bare", "low_m"),
    [
        (SHEET, 1.0, True, 0.0),  # no floor that it would lie in
        (SHEET, 1.0, False, 1e-3),
        (SHEET.replace("v 0 0 0", "v 0 5e-7 0"), 1000.0, False, 1e-3),  # 0.5 mm in a kilometre
        (TIP, 1e-7, False, 0.0),  # 0.1 micrometres tall and as wide
        (TIP, 1e-7, True, 0.0),
    ],
)
def test_what_is_level_for_its_size_is_lifted_where_there_is_a_floor(tmp_path, text, scale, bare, low_m):
    path = tmp_path / "a.obj"
    path.write_text(text)
    scene = load_mesh(path, placing=Placing(scale=scale, bare=bare))
    assert scene.surfaces[0].vertices[:, 1].min() == low_m
    assert any("lifted" in note for note in scene.notes) == (low_m > 0)


def test_a_larger_scene_looks_the_same(tmp_path):
    path = xml_files.write(
        tmp_path, '<shape type="rectangle"><transform name="toWorld"><translate z="4"/></transform></shape>'
    )
    small, large = (load_scene(str(path), placing=Placing(scale=scale)) for scale in (None, 0.01))
    assert np.allclose(large.surfaces[0].vertices, 0.01 * small.surfaces[0].vertices)
    back = scaled(large, 100.0)
    assert np.allclose(back.camera.pose, small.camera.pose)
    with pytest.raises(InputError, match="for mesh files"):
        load_scene(str(path), placing=Placing(up="z"))


def test_a_camera_looks_at_what_is_asked_for_in_any_scene():
    scene = load_scene("plane", placing=Placing(target=(1.0, 0.0, -3.0)))
    axis = scene.camera.pose[:3, 2]
    assert np.allclose(axis, np.array((1, 0, -3)) / math.sqrt(10))


@pytest.mark.parametrize("distance_m", [0.4, 50.0, 2000.0])
def test_a_wall_stands_where_its_name_says(distance_m):
    scene = load_scene(f"wall@{distance_m:g}", width=16, height=64)
    wall = scene.surfaces[0].vertices
    assert np.allclose(wall[:, 2], -distance_m)
    assert np.abs(wall[:, :2]).min() > distance_m * math.tan(math.radians(scene.camera.fov_deg / 2)) * 4


@pytest.mark.parametrize("name", ["wall@", "wall@zero", "wall@0", "wall@-3", "wall@1e9", "wall@nan"])
def test_a_wall_at_no_place_is_refused(name):
    with pytest.raises(InputError, match="metres from"):
        load_scene(name)


@pytest.mark.parametrize(
    "values",
    [{"up": "w"}, {"scale": 0.0}, {"scale": math.nan}, {"origin": (0.0, math.inf, 0.0)}, {"target": (math.nan,) * 3}],
)
def test_a_placing_that_makes_no_sense_is_refused(values):
    with pytest.raises(InputError):
        Placing(**values)


# Light


def test_a_black_body_has_its_luminance():
    """At 2,856 K (CIE illuminant A) the eye's weighted mean is near Planck's law at some 575 nm."""
    assert seen_radiance_w_per_m2_sr_nm(2856) == pytest.approx(planck_w_per_m2_nm(575e-9, 2856) / math.pi, rel=0.1)
    assert seen_radiance_w_per_m2_sr_nm(6500) > 30 * seen_radiance_w_per_m2_sr_nm(2856)


def test_a_sky_as_bright_as_sunlight():
    """100 klux are 0.82 W/(m2 nm) at 850 nm (docs/radiometric.md); an even sky of E / pi gives a level surface E."""
    assert sunlit_sky_w_per_m2_sr_nm(1e5, 850e-9) * math.pi == pytest.approx(0.8175, rel=1e-3)


@pytest.mark.parametrize(
    ("body", "version"),
    [
        ('<blackbody name="radiance" temperature="5000K"/>', "0.6.0"),
        ('<spectrum name="radiance" type="blackbody"><float name="temperature" value="5000"/></spectrum>', "3.0.0"),
    ],
)
def test_lamps_that_are_black_bodies(tmp_path, body, version):
    scene = xml_files.load(
        tmp_path, f'<shape type="rectangle"><emitter type="area">{body}</emitter></shape>', version=version
    )
    assert scene.surfaces[0].emission == pytest.approx(seen_radiance_w_per_m2_sr_nm(5000))


# Constructs of other people's files


def test_a_default_inside_an_element_counts(tmp_path):
    body = '<bsdf type="diffuse" id="b"><default name="r" value="0.25"/><float name="reflectance" value="$r"/></bsdf>'
    scene = xml_files.load(tmp_path, f'{body}<shape type="rectangle"><ref id="b"/></shape>')
    assert scene.surfaces[0].material.albedo == 0.25


def test_phong_becomes_plastic_of_the_same_width(tmp_path):
    found = xml_files.material(
        tmp_path,
        '<bsdf type="phong"><float name="exponent" value="198"/><float name="diffuseReflectance" value="0.3"/></bsdf>',
    )
    assert (found.kind, found.albedo, found.distribution) == ("roughplastic", 0.3, "beckmann")
    assert found.roughness == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<shape type="rectangle"><bsdf type="roughdielectric"/></shape>', "write dielectric"),
        ('<shape type="rectangle"><medium type="homogeneous" name="interior"/></shape>', "remove it"),
        ('<shape type="instance"/>', "of one shapegroup"),
        ('<shape type="hair"/>', "thin cylinders or a mesh"),
    ],
)
def test_refusals_name_the_way_round_before_meshes_are_read(tmp_path, body, message):
    """The mesh before it is broken and would be refused first if it were read first."""
    (tmp_path / "broken.obj").write_text("v 0 0\n")
    first = '<shape type="obj"><string name="filename" value="broken.obj"/></shape>'
    assert message in xml_files.refusal(tmp_path, first + body)


# The command line


def test_render_takes_size_camera_laser_and_sunlight(tip, tmp_path, capfd):
    from render.transient import read_transient
    from scene2spad.cli import main

    out = tmp_path / "tip.exr"
    words = "--up z --scale 2 --from 1 1 4 --look-at 0 0.5 0 --fov 30 --baseline 0.05 0 0 --sunlight 5e4 --bare"
    command = ["render", str(tip), *words.split(), "--width", "16", "--bounces", "1", "--no-figure", "--out", str(out)]
    assert main([*command, "--ambient", "on", "--ambient-spp", "4", "--json"]) == 0
    capfd.readouterr()
    seen = read_transient(out)
    assert np.nanmin(seen.depth_m) == pytest.approx(math.dist((1, 1, 4), (0, 0.5, 0)), abs=1.0)
    assert seen.meta["laser"]["baseline_m"] == [0.05, 0.0, 0.0]
    # an even sky on what reflects 60 %, nothing around it to shade it
    sky = sunlit_sky_w_per_m2_sr_nm(5e4, 850e-9)
    lit = seen.ambient[np.isfinite(seen.depth_m)].astype(float)
    assert np.median(lit) == pytest.approx(0.6 * sky, rel=0.15)


@pytest.mark.parametrize("lux", [0, 5e4])
def test_sunlight_replaces_lamps_and_surroundings_alike(tmp_path, capfd, lux):
    """A grey wall with a lamp as bright as itself, under a constant light: the sky that is asked for is all it has."""
    from render.transient import read_transient
    from scene2spad.cli import main

    body = (
        '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><translate z="2"/></transform>'
        '<bsdf type="diffuse"/><emitter type="area"><float name="radiance" value="7"/></emitter></shape>'
        '<emitter type="constant"><float name="radiance" value="3"/></emitter>'
    )
    path, out = xml_files.write(tmp_path, body), tmp_path / "lamp.exr"
    words = f"--sunlight {lux:g} --width 8 --bounces 1 --grid 2 --ambient on --ambient-spp 16 --no-figure"
    assert main(["render", str(path), *words.split(), "--out", str(out)]) == 0
    capfd.readouterr()
    seen = read_transient(out)
    lit = seen.ambient[np.isfinite(seen.depth_m)].astype(float)
    assert np.median(lit) == pytest.approx(0.5 * sunlit_sky_w_per_m2_sr_nm(lux, 850e-9), rel=0.15)


def test_a_scene_in_other_units_is_questioned(tmp_path, capfd):
    from scene2spad.cli import main

    command = ["render", "wall@2000", "--width", "8", "--bounces", "1", "--grid", "2", "--no-figure"]
    assert main([*command, "--out", str(tmp_path / "w.exr")]) == 0
    assert "say so by --scale" in capfd.readouterr().err


@pytest.mark.parametrize(("name", "first", "second"), [("scale", 2.0, 3.0), ("up", "z", "z"), ("bare", True, False)])
def test_a_field_given_twice_is_refused(tip, name, first, second):
    with pytest.raises(InputError, match=f"load_scene: {name} is given twice, as {second!r} and as {first!r}"):
        load_scene(str(tip), placing=Placing(**{name: first}), **{name: second})
