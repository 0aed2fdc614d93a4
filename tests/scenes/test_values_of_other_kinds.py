"""Refuse values of another kind in the classes of a scene in one line, never by a bare exception."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from fractions import Fraction

import numpy as np
import pytest

from render.settings import RenderSettings
from scenes import Ambient, Camera, InputError, Laser, Material, Scene, Surface, Texture
from scenes.library.catalog import load_scene
from scenes.placing import Placing

CORNERS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
VIEW = Camera(np.eye(4), 60, 8, 6)
SHEET = Surface(CORNERS, [[0, 1, 2]])
BEYOND = 10**400  # no float


def look(origin: object = (0, 0, 0), target: object = (0, 0, 1), up: object = (0, 1, 0)) -> Camera:
    return Camera.look_at(origin, target, fov_deg=60, width=4, height=4, up=up)


def mesh(**changes: object) -> Surface:
    return Surface(**{"vertices": CORNERS, "faces": [[0, 1, 2]]} | changes)


def scene(**changes: object) -> Scene:
    return Scene(**{"name": "a", "surfaces": [SHEET], "camera": VIEW} | changes)


def refused(make: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Texture("a", "b"), "texture b: not an array of numbers"),
        (lambda: Texture([[1.0], [1.0, 2.0]], "b"), "texture b: not an array of numbers"),
        (lambda: Texture([[1j]], "b"), "texture b: not an array of numbers"),
        (lambda: Texture([[1.0]], 3), "texture: name: expected a str, not int"),
        (lambda: Material(["diffuse"]), "material material: kind ['diffuse'] is unknown, expected one of diffuse"),
        (lambda: Material(np.zeros(2)), "material material: kind array([0., 0.]) is unknown"),
        (lambda: Material(distribution=3), "material material: distribution 3 is unknown"),
        (lambda: Material(albedo="red"), "material material: albedo 'red' is not a finite number"),
        (lambda: Material(albedo=True), "material material: albedo True is not a finite number"),
        (lambda: Material(ior=np.complex64(1.5)), "material material: ior np.complex64(1.5+0j) is not a finite number"),
        (lambda: Material(k=BEYOND), "is not a finite number"),
        (lambda: Material(name=None), "material: name: expected a str, not NoneType"),
        (lambda: mesh(material="red"), "mesh surface: material: expected a Material, not str"),
        (lambda: mesh(vertices=None), "mesh surface: vertices: "),
        (lambda: mesh(vertices=[["0", "0", "0"]] * 3), "mesh surface: vertices: not an array of numbers"),
        (lambda: mesh(vertices=np.array(CORNERS) * 1j), "mesh surface: vertices: not an array of numbers"),
        (lambda: mesh(uv="a"), "mesh surface: uv: not an array of numbers"),
        (lambda: mesh(normals=3), "mesh surface: normals: shape ()"),
        (lambda: mesh(emission="bright"), "mesh surface: emission 'bright' is not a finite number"),
        (lambda: mesh(name=3), "mesh: name: expected a str, not int"),
        (lambda: Camera(None, 60, 8, 6), "camera pose: "),
        (lambda: Camera(np.eye(4), "60", 8, 6), "camera fov '60' is not a finite number"),
        (lambda: Camera(np.eye(4), 60, "8", 6), "camera width '8' is not a finite number"),
        (lambda: look(origin=3), "camera position 3 is not three finite numbers"),
        (lambda: look(origin=(0, 0)), "camera position (0, 0) is not three finite numbers"),
        (lambda: look(target="abc"), "point to look at 'abc' is not three finite numbers"),
        (lambda: look(target=(0, 0, np.nan)), "point to look at (0, 0, nan) is not three finite numbers"),
        (lambda: look(up=None), "up direction None is not three finite numbers"),
        (lambda: VIEW.resized("a"), "camera width 'a' is not a finite number"),
        (lambda: VIEW.resized(height="a"), "camera height 'a' is not a finite number"),
        (lambda: VIEW.resized(BEYOND), "is not a finite number"),
        (lambda: Laser(["flood"]), "laser mode ['flood'] is unknown, expected one of flood, line, scan"),
        (lambda: Laser(baseline_m=3), "laser baseline [m] 3 is not three finite numbers"),
        (lambda: Laser(baseline_m=("a", 0, 0)), "laser baseline [m] ('a', 0, 0) is not three finite numbers"),
        (lambda: Laser(cone_deg="x"), "laser cone 'x' is not a finite number"),
        (lambda: Ambient("bright"), "ambient radiance 'bright' is not a finite number"),
        (lambda: Ambient(environment=np.zeros((2, 2))), "ambient environment: expected a Texture, not ndarray"),
        (lambda: Ambient(pose=3), "environment pose: "),
        (lambda: scene(surfaces=[3]), "scene a: surfaces[0]: expected a Surface, not int"),
        (lambda: scene(surfaces=[SHEET, "b"]), "scene a: surfaces[1]: expected a Surface, not str"),
        (lambda: scene(surfaces=SHEET), "scene a: surfaces: expected a list of Surface, not Surface"),
        (lambda: scene(surfaces=None), "scene a: surfaces: expected a list of Surface, not NoneType"),
        (lambda: scene(camera=None), "scene a: camera: expected a Camera, not NoneType"),
        (lambda: scene(laser="flood"), "scene a: laser: expected a Laser, not str"),
        (lambda: scene(ambient=3.0), "scene a: ambient: expected an Ambient, not float"),
        (lambda: scene(notes="hello"), "scene a: notes: expected a list of str, not str"),
        (lambda: scene(notes=[3]), "scene a: notes[0]: expected a str, not int"),
        (lambda: scene(name=3), "scene: name: expected a str, not int"),
        (lambda: Placing(up=3), "up axis 3 is unknown, expected one of x, y, z"),
        (lambda: Placing(scale="a"), "scale [metres a unit] 'a' is not a finite number"),
        (lambda: Placing(origin=3), "camera position 3 is not three finite numbers"),
        (lambda: Placing(target=(0, 0)), "point to look at (0, 0) is not three finite numbers"),
        (lambda: RenderSettings(indirect_growth=1e-7), "render: indirect_growth 1e-07 is neither 0 nor 1e-4 to 1"),
        (lambda: RenderSettings(indirect_growth=True), "render: indirect_growth True, expected a number"),
        (lambda: Placing(fov_deg="a"), "camera fov 'a' is not a finite number"),
        (lambda: Placing(bare="no"), "placing: bare 'no', expected True or False"),
    ],
)
def test_a_value_of_another_kind_is_refused(make: Callable[[], object], message: str) -> None:
    assert message in refused(make)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 2.9]], "2.9 is not a whole number"),
        (np.array([[0, 1, -0.5]], np.float32), "-0.5 is not a whole number"),
        ([[0, 1, Fraction(3, 2)]], "1.5 is not a whole number"),
        ([[0, 1, np.nan]], "nan is not a whole number"),
        ([[False, True, True]], "not an array of numbers"),
        ([[0, 1, 10**30]], "not an array of numbers"),
    ],
)
def test_indices_that_are_no_whole_numbers_are_refused(faces: object, message: str) -> None:
    """They would be cut to the number below, which is another vertex."""
    assert f"mesh surface: faces: {message}" in refused(lambda: mesh(faces=faces))


@pytest.mark.parametrize("faces", [[[0.0, 1.0, 2.0]], np.array([[0, 1, 2]], np.uint8), [(0, 1, 2)]])
def test_whole_indices_of_any_type_are_taken(faces: object) -> None:
    assert mesh(faces=faces).faces.tolist() == [[0, 1, 2]]


def test_numbers_of_numpy_become_pythons_own() -> None:
    """Files state them in JSON, and a scene's hash does not tell how its numbers were given."""
    settings = RenderSettings(error=np.float32(0.05), clamp=np.float64(10), bounces=np.int64(2))
    assert type(settings.error) is type(settings.clamp) is float and type(settings.bounces) is int
    cones = [Laser(cone_deg=cone).cone_deg for cone in (30, 30.0, np.float32(30))]
    assert {type(cone) for cone in cones} == {float} and set(cones) == {30.0}


def test_surfaces_and_notes_come_from_any_iterable() -> None:
    made = scene(surfaces=(one for one in [SHEET, SHEET]), notes=iter(["two  words"]))
    assert made.surfaces == (SHEET, SHEET) and made.notes == ("two words",)


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("quad.obj", {"width": "a"}, "camera width 'a' is not a finite number"),
        ("plane", {"height": "a"}, "camera height 'a' is not a finite number"),
        ("hall", {"width": 2.5}, "camera width 2.5 is outside 1 to 16384 whole pixels"),
        ("tabletop/spikes", {"width": "a"}, "camera width 'a' is not a finite number"),
        ("rooms/train/0", {"seed": "a"}, "set rooms/train: seed 'a', expected a whole number"),
        ("plane", {"placing": 3}, "load_scene: placing: expected a Placing (scenes.placing), not int"),
        ("plane", {"scale": "a"}, "scale [metres a unit] 'a' is not a finite number"),
        ("plane", {"bare": True}, "an upward axis and `bare` are for mesh files"),
        (
            "plane",
            {"skale": 2},
            "load_scene: 'skale' is unknown, expected fields of Placing: up, scale, origin, target, fov_deg, bare; "
            "did you mean 'scale'?",
        ),
    ],
)
def test_loading_with_a_value_of_another_kind_is_refused(name: str, given: dict, message: str) -> None:
    assert message in refused(lambda: load_scene(name, **given))


def test_kinds_are_those_of_the_source_whatever_becomes_of_a_fields_type():
    """Libraries that walk over dataclasses replace the words of a field's type by the type itself."""
    kept = [(item, item.type) for item in fields(RenderSettings)]
    try:
        for item, _ in kept:
            item.type = object
        assert refused(lambda: RenderSettings(filter="on")) == "render: filter 'on', expected True or False"
        assert refused(lambda: RenderSettings(direct_tolerance_m="a")).endswith("expected a number")
        assert type(RenderSettings(indirect_growth=np.float32(0.5)).indirect_growth) is float
    finally:
        for item, kind in kept:
            item.type = kind
