"""Mitsuba files: camera, light and files of a Mitsuba scene, against Mitsuba itself and against closed forms."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from xml_files import LUMINANCE, RECTANGLE, SENSOR, load, refusal, texel, write

from scenes import Ambient, InputError, Texture
from scenes.io.mitsuba.scene_file import load_mitsuba_xml

DATA = Path(os.environ.get("SCENE2SPAD_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
LIVING_ROOM = DATA / "scenes" / "living-room" / "scene.xml"

# --- the camera ---------------------------------------------------------------------------------------------------

TO_WORLD = {
    "identity": "",
    "lookat": '<lookat origin="1, 2, 3" target="-1 0.5 9" up="0.1 1 0"/>',
    "chain": '<scale value="2"/><rotate y="1" angle="35"/><rotate x="1" z="0.5" angle="-20"/><translate x="1" z="-4"/>',
    "matrix": '<matrix value="0 0 1 5  0 1 0 6  -1 0 0 7  0 0 0 1"/>',
    "small matrix": '<matrix value="0 0 1  0 1 0  -1 0 0"/><translate value="1 2 3"/>',
}
FOV = [
    '<float name="fov" value="70"/>',
    *(
        f'<float name="fov" value="50"/><string name="fov_axis" value="{axis}"/>'
        for axis in ("x", "y", "diagonal", "smaller", "larger")
    ),
    '<string name="focal_length" value="28mm"/>',
    "",
]


def camera_xml(to_world: str, fov: str, width: int = 40, height: int = 24, kind: str = "perspective") -> str:
    film = f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
    return (
        f'<sensor type="{kind}">{fov}<transform name="to_world">{to_world}</transform>'
        f'<film type="hdrfilm">{film}</film></sensor>'
    )


@pytest.mark.parametrize("to_world", [v for k, v in TO_WORLD.items() if k != "chain"], ids=lambda v: v[:10])
@pytest.mark.parametrize("size", [(40, 24), (20, 32)])
def test_camera_rays_are_mitsubas(tmp_path: Path, mitsuba: object, to_world: str, size: tuple[int, int]) -> None:
    raster = [(0.1, 0.2), (0.9, 0.3), (0.5, 0.5), (0.25, 0.85)]
    for fov in FOV:
        path = write(tmp_path, RECTANGLE, sensor=camera_xml(to_world, fov, *size))
        camera = load_mitsuba_xml(path).camera
        expected = np.array(mitsuba(path, raster=raster)["camera"])
        rays = camera.rays(*(np.array(raster) * size).T)
        np.testing.assert_allclose(rays, expected[:, 3:], atol=2e-6)
        # Mitsuba's rays start on the near plane: the camera lies on them.
        off_axis = np.cross(expected[:, :3] - camera.origin, rays)
        np.testing.assert_allclose(off_axis, 0, atol=2e-5)


def test_steps_of_a_transform_apply_in_order(tmp_path: Path) -> None:
    sensor = camera_xml(TO_WORLD["chain"], FOV[0])
    scene = load(tmp_path, '<shape type="sphere"/>', sensor=sensor)
    yaw, pitch = math.radians(35), math.radians(-20)
    axis = np.array([1, 0, 0.5]) / math.hypot(1, 0.5)
    forward = np.array([math.sin(yaw), 0, math.cos(yaw)])
    forward = (
        forward * math.cos(pitch)
        + np.cross(axis, forward) * math.sin(pitch)
        + axis * (axis @ forward) * (1 - math.cos(pitch))
    )
    np.testing.assert_allclose(scene.camera.rotation[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(scene.camera.origin, (1, 0, -4))
    assert ["<rotate>" in note for note in scene.notes] == [True]


def test_left_in_mitsuba_is_left_here(tmp_path: Path) -> None:
    """Mitsuba's camera without a transform looks along +z with +x to its left and +y up."""
    camera = load(tmp_path, RECTANGLE).camera
    rays = camera.rays()
    assert rays[0, 0, 0] > 0 > rays[0, -1, 0] and rays[0, 0, 1] > 0 > rays[-1, 0, 1]
    assert (rays[..., 2] > 0).all()
    np.testing.assert_allclose(
        rays[2, 0], np.array([3.5, 0.5, 4 / math.tan(math.pi / 6)]) / np.linalg.norm([3.5, 0.5, 4 * 3**0.5])
    )


def test_another_size_keeps_the_horizontal_angle(tmp_path: Path) -> None:
    path = write(tmp_path, RECTANGLE)
    assert (load_mitsuba_xml(path, width=64).camera.width, load_mitsuba_xml(path, width=64).camera.height) == (64, 48)
    camera = load_mitsuba_xml(path, width=30, height=90).camera
    assert (camera.width, camera.height, camera.fov_deg) == (30, 90, 60)


@pytest.mark.parametrize(
    ("to_world", "note"),
    [
        ('<scale x="1" y="2" z="3"/>', "stretches"),
        ('<scale x="-1"/>', "mirrors"),
        ('<matrix value="1.0001 0 0 0  0 1 2e-4 0  0 0 1 0  0 0 0 1"/>', ""),
        ('<scale value="3"/>', ""),
    ],
)
def test_camera_transform_is_made_rigid(tmp_path: Path, to_world: str, note: str) -> None:
    scene = load(tmp_path, RECTANGLE, sensor=camera_xml(to_world, FOV[0]))
    np.testing.assert_allclose(scene.camera.rotation, np.diag((-1, -1, 1)), atol=3e-4)
    assert [note in line for line in scene.notes] == ([True] if note else [])


def test_sensor_variants_are_noted(tmp_path: Path) -> None:
    lens = camera_xml("", '<float name="aperture_radius" value="0.1"/>' + FOV[0], kind="thinlens")
    scene = load(tmp_path, RECTANGLE, sensor=lens + SENSOR)
    assert scene.camera.fov_deg == 70
    assert any("pinhole" in line for line in scene.notes) and any("2 sensors" in line for line in scene.notes)
    legacy = camera_xml("", '<float name="fov" value="50"/><string name="fovAxis" value="y"/>').replace("to_w", "toW")
    fov = load(tmp_path, RECTANGLE, sensor=legacy, version="0.6.0").camera.fov_deg
    assert fov == pytest.approx(math.degrees(2 * math.atan(math.tan(math.radians(25)) * 40 / 24)))


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("", "no sensor"),
        ('<sensor type="orthographic"/>', "orthographic"),
        (camera_xml("", '<float name="fov" value="200"/>'), "outside 0 to 180"),
        (camera_xml("", '<float name="fov" value="175"/>'), "outside 0.01 to 170"),
        (camera_xml("", '<float name="fov" value="abc"/>'), "abc"),
        (camera_xml("", '<float name="fov" value="nan"/>'), "finite"),
        (camera_xml("", FOV[0] + '<string name="fov_axis" value="z"/>'), "fov_axis 'z'"),
        (camera_xml("", '<string name="focal_length" value="long"/>'), "millimetres"),
        (camera_xml('<matrix value="1 0 0"/>', FOV[0]), "3 values, expected 16 or 9"),
        (camera_xml('<scale value="0"/>', FOV[0]), "determinant"),
        (camera_xml('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 1 0 1"/>', FOV[0]), "last row"),
        (camera_xml('<twist value="0"/>', FOV[0]), "<twist>"),
        (camera_xml('<lookat origin="0 0 0" target="0 0 0" up="0 1 0"/>', FOV[0]), "same point"),
        (camera_xml('<lookat origin="0 0 0" target="0 2 0" up="0 1 0"/>', FOV[0]), "viewing direction"),
        (camera_xml('<lookat origin="0 0 0" up="0 1 0"/>', FOV[0]), 'lacks target="..."'),
        (camera_xml('<rotate angle="3"/>', FOV[0]), "no axis"),
        (camera_xml("", FOV[0], width=0), "0 x 24"),
    ],
)
def test_bad_sensors_are_refused(tmp_path: Path, sensor: str, words: str) -> None:
    assert words in refusal(tmp_path, RECTANGLE, sensor=sensor)


# --- light --------------------------------------------------------------------------------------------------------


def exr(path: Path, values: np.ndarray) -> None:
    import OpenEXR

    rgb = np.repeat(values[..., None], 3, axis=-1).astype(np.float32)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(header, {"RGB": OpenEXR.Channel(rgb)}) as file:
        file.write(str(path))


def around(ambient: Ambient, direction: np.ndarray) -> float:
    """The map's value where Mitsuba's envmap has it: u from atan2(x, -z), v from the angle to +y."""
    x, y, z = ambient.pose[:3, :3].T @ direction
    return texel(ambient.environment, np.array([math.atan2(x, -z) / (2 * math.pi), 1 - math.acos(y) / math.pi]))


@pytest.mark.parametrize("turn", ["", '<rotate y="1" angle="90"/>', '<rotate x="1" angle="30"/>', '<scale x="-1"/>'])
def test_envmap_is_mitsubas(tmp_path: Path, mitsuba: object, turn: str) -> None:
    values = np.kron(np.arange(1, 19).reshape(3, 6), np.ones((20, 20)))
    exr(tmp_path / "sky.exr", values)
    body = '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="0.5"/>'
    body += f'<transform name="to_world">{turn}</transform></emitter>'
    path = write(tmp_path, RECTANGLE + body)
    scene = load_mitsuba_xml(path)
    directions = np.random.default_rng(3).normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.array(mitsuba(path, around=directions)["around"])
    ours = np.array([around(scene.ambient, d) for d in directions])
    # Mitsuba interpolates: only directions inside a block of equal pixels compare.
    inside = abs(expected * 2 - np.round(expected * 2)) < 1e-3
    assert inside.sum() > 45
    np.testing.assert_allclose(ours[inside], expected[inside], rtol=1e-3)
    assert any("mirrors" in note for note in scene.notes) == ("scale" in turn)


def test_a_scaled_envmap_is_noted_as_mitsuba_distorts_it(tmp_path: Path, mitsuba: object) -> None:
    """An envmap under a scale of 3 keeps its rotation here; in Mitsuba straight up shows its rows at acos(1/3)."""
    exr(tmp_path / "sky.exr", np.repeat(np.repeat([[1.0], [2.0], [3.0]], 20, axis=0), 40, axis=1))
    body = '<emitter type="envmap"><string name="filename" value="sky.exr"/>'
    path = write(tmp_path, f'{RECTANGLE}{body}<transform name="to_world"><scale value="3"/></transform></emitter>')
    scene = load_mitsuba_xml(path)
    up = np.array([0.01, 0.9999, 0.01]) / np.linalg.norm([0.01, 0.9999, 0.01])
    assert mitsuba(path, around=[up.tolist()])["around"] == pytest.approx([2.0], rel=1e-3)
    assert around(scene.ambient, up) == pytest.approx(1.0, rel=1e-3)
    assert any("scale of the environment map" in note for note in scene.notes)
    turn = '<transform name="to_world"><rotate x="1" angle="5"/></transform></emitter>'
    turned = write(tmp_path, RECTANGLE + body + turn)
    assert not load_mitsuba_xml(turned).notes


def test_lights(tmp_path: Path) -> None:
    body = RECTANGLE + '<emitter type="constant"><rgb name="radiance" value="0.2 0.4 0.6"/></emitter>'
    body += '<emitter type="point" id="lamp"/><emitter type="sunsky"/>'
    scene = load(tmp_path, body)
    assert scene.ambient.radiance == pytest.approx(LUMINANCE) and scene.laser.is_colocated
    assert [note for note in scene.notes if note.endswith(": lamp, sunsky")]
    checks = (
        '<texture type="checkerboard" name="radiance"><float name="color0" value="4"/><float name="color1" value="2"/>'
    )
    lamp = load(tmp_path, f'<shape type="cube"><emitter type="area">{checks}</texture></emitter></shape>')
    assert lamp.surfaces[0].emission == pytest.approx(3) and any("mean" in note for note in lamp.notes)


@pytest.mark.parametrize(
    ("emitter", "words"),
    [
        ('<emitter type="constant"/><emitter type="constant"/>', "second light"),
        ('<emitter type="envmap"/>', "filename"),
        ('<emitter type="envmap"><string name="filename" value="sky.hdr"/></emitter>', "convert it to .exr"),
        ('<emitter type="envmap"><string name="filename" value="bad.exr"/></emitter>', "broken EXR"),
        ('<emitter type="area"/>', "inside its <shape>"),
        ('<emitter type="glow"/>', "'glow'"),
        ('<emitter type="constant"><rgb name="radiance" value="-1"/></emitter>', "negative"),
        ('<emitter type="constant"><blackbody name="radiance" value="3000"/></emitter>', "temperature of radiance"),
    ],
)
def test_bad_lights_are_refused(tmp_path: Path, emitter: str, words: str) -> None:
    (tmp_path / "bad.exr").write_text("no image")
    assert words in refusal(tmp_path, RECTANGLE + emitter)


# --- the file -----------------------------------------------------------------------------------------------------


def test_defaults_and_includes(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    write(
        tmp_path / "parts",
        '<bsdf type="diffuse" id="m"><float name="reflectance" value="$r"/></bsdf>',
        sensor="",
        name="m.xml",
    )
    body = '<default name="r" value="0.3"/><default name="r" value="0.4"/><default name="dir" value="parts"/>'
    body += '<include filename="$dir/m.xml"/><integrator type="path"><integer name="max_depth" value="3"/></integrator>'
    scene = load(tmp_path, body + '<shape type="sphere" id="ball"><ref id="m"/></shape>')
    assert scene.surfaces[0].material.albedo == 0.3 and scene.surfaces[0].name == "ball" and scene.name == "a"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<include filename="a.xml"/>', "includes itself"),
        ('<include filename="b.xml"/>', "includes itself"),
        ('<include filename="../out.xml"/>', "outside the scene's folder"),
        ('<include filename="link.xml"/>', "outside the scene's folder"),
        ('<include filename="none.xml"/>', "not found"),
        ("<include/>", 'lacks filename="..."'),
        ('<default name="x"/>', 'lacks value="..."'),
        ('<shape type="$kind"/>', "$kind has no value"),
        ('<alias id="none" as="x"/>', "unknown id 'none'"),
        ('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>', "given twice"),
    ],
)
def test_bad_includes_and_names_are_refused(tmp_path: Path, body: str, words: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    write(tmp_path, RECTANGLE, sensor="", name="out.xml")
    (folder / "link.xml").symlink_to(tmp_path / "out.xml")
    path = write(folder, body)
    write(folder, '<include filename="a.xml"/>', sensor="", name="b.xml")
    with pytest.raises(InputError) as error:
        load_mitsuba_xml(path)
    assert words in str(error.value) and "\n" not in str(error.value) and str(error.value).startswith(str(folder))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<scene version='3.0.0'>\n<shape></scene>", "broken XML, line 2"),
        ("", "broken XML, line 1"),
        ("<?xml version='1.0' encoding='none'?><scene/>", "broken XML"),
        ("<scene/>", "version=None"),
        ("<scene version='9.0.0'/>", "version='9.0.0'"),
        ("<shape version='3.0.0' type='sphere'/>", "outermost element is <shape>"),
        ("<!DOCTYPE scene [<!ENTITY a 'b'>]><scene version='3.0.0'>&a;</scene>", "DOCTYPE"),
        ("<!DOCTYPE scene SYSTEM 'x.dtd'><scene version='3.0.0'/>", "DOCTYPE"),
        ("<scene version='3.0.0'>&a;</scene>", "undefined entity"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(text.encode(encoding))
        with pytest.raises(InputError) as error:
            load_mitsuba_xml(path)
        assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)
        if encoding == "utf-8":
            assert words in str(error.value)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.xml", tmp_path):
        with pytest.raises(InputError, match=r"not found|cannot be read"):
            load_mitsuba_xml(path)


# --- the artist's scene -------------------------------------------------------------------------------------------


def test_artists_living_room() -> None:
    if not LIVING_ROOM.is_file():
        pytest.skip(
            f"{LIVING_ROOM.name} of the artist's living room is not there; set SCENE2SPAD_DATA to its data folder"
        )
    scene = load_mitsuba_xml(LIVING_ROOM)
    camera = scene.camera
    assert (len(scene.surfaces), camera.fov_deg, camera.width, camera.height) == (65, 90, 1280, 720)
    assert scene.name == "living-room"
    # The third column of the file's matrix is the viewing direction, the first its left.
    np.testing.assert_allclose(camera.rotation[:, 2], (-0.961792, 0.074407, 0.263476), atol=1e-5)
    np.testing.assert_allclose(camera.rotation[:, 0], (-0.264209, 0, -0.964465), atol=1e-5)
    leaves = [surface for surface in scene.surfaces if surface.material.name == "Leaves"]
    assert len(leaves) > 1 and len({id(leaf.material) for leaf in leaves}) == 1
    opacity = leaves[0].material.opacity
    # Mitsuba's `mask` of this image lets through what its luminance leaves, 0.0452 at least: alpha has no part in it.
    assert isinstance(opacity, Texture) and opacity.image.max() == 1
    assert opacity.image.min() == pytest.approx(0.045227, abs=1e-5)
    assert scene.ambient.environment is not None and scene.ambient.environment.image.shape == (1024, 2048)
    assert {s.material.kind for s in scene.surfaces} >= {"dielectric", "conductor", "roughconductor", "roughplastic"}
    assert all(surface.uv is not None for surface in scene.surfaces)
    assert scene.notes == ()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (
            f'{RECTANGLE}<emitter type="constant"><float name="radiance" value="1e300"/></emitter>',
            "1e+300 is above 1e+09",
        ),
        (
            '<shape type="rectangle"><emitter type="area"><float name="radiance" value="1e300"/></emitter></shape>',
            "emission 1e+300 is above 1e+09",
        ),
        (
            '<shape type="sphere"><transform name="to_world"><scale value="1e200"/></transform></shape>',
            "to_world: <scale> makes an entry of 1e+200, beyond 1e+15",
        ),
        (
            '<shape type="cube"><transform name="to_world"><scale value="1e9"/></transform></shape>',
            "a vertex at 1e+09 m is beyond 1e+07 m",
        ),
    ],
)
def test_numbers_beyond_physics_are_refused_in_one_line(tmp_path: Path, body: str, words: str) -> None:
    assert words in refusal(tmp_path, body)
