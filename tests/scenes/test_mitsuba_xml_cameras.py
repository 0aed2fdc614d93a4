"""Check that notes name what a camera of a Mitsuba file leaves out, and what a transform of large numbers is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenes import Surface
from tests.scenes.xml_files import SENSOR, load


def clipped(folder: Path, near: float, far: float, shapes: str) -> list[str]:
    clips = f'<float name="near_clip" value="{near}"/><float name="far_clip" value="{far}"/>'
    scene = load(folder, shapes, sensor=SENSOR.replace("<film", f"{clips}<film"))
    return [note for note in scene.notes if "near_clip" in note]


def rectangle(name: str, z: float, *, x: float = 0.0) -> str:
    move = f'<transform name="to_world"><scale value="0.1"/><translate x="{x}" z="{z}"/></transform>'
    return f'<shape type="rectangle" id="{name}">{move}</shape>'


def test_what_the_clipping_planes_cut_is_named_in_one_line(tmp_path: Path) -> None:
    shapes = "".join(rectangle(f"at{z}", z) for z in (1, 3, 9))
    shapes += rectangle("aside", 1.5, x=5) + rectangle("behind", -0.5)
    (note,) = clipped(tmp_path, 2, 8, shapes)
    assert note == "is seen nearer than near_clip 2 or beyond far_clip 8, in Mitsuba it is cut off there: at1, at9"
    assert clipped(tmp_path, 0.5, 10, shapes) == []


@pytest.mark.parametrize(("height", "noted"), [(-1.0, 0), (-0.005, 1)])
def test_a_floor_below_the_camera_is_cut_only_where_it_is_seen(tmp_path: Path, height: float, noted: int) -> None:
    """Judge a floor whose triangles go past the camera by its part in view."""
    turn = '<rotate x="1" angle="-90"/><scale value="20"/>'
    floor = f'<shape type="rectangle"><transform name="to_world">{turn}<translate y="{height}"/></transform></shape>'
    assert len(clipped(tmp_path, 0.1, 100, floor)) == noted


@pytest.mark.parametrize(
    ("version", "axis", "noted"), [("3.0.0", 'y="2"', 1), ("3.0.0", 'y="1"', 0), ("0.6.0", 'y="2"', 0)]
)
def test_an_axis_that_is_not_of_unit_length_is_named(tmp_path: Path, version: str, axis: str, noted: int) -> None:
    turn = f'<transform name="to_world"><rotate {axis} angle="20"/><translate z="2"/></transform>'
    notes = load(tmp_path, f'<shape type="rectangle" id="board">{turn}</shape>', version=version).notes
    assert sum("<rotate>" in note and note.endswith(": board") for note in notes) == noted


@pytest.mark.filterwarnings("error")
def test_the_length_of_an_axis_has_no_part_in_a_transform(tmp_path: Path) -> None:
    """Squares of 1e300 overflowed: numpy's warnings went to stderr, and a turn became none."""

    def turned(step: str) -> Surface:
        return load(tmp_path, f'<shape type="cube"><transform name="to_world">{step}</transform></shape>').surfaces[0]

    for step in ('<rotate z="{}" angle="30"/>', '<lookat origin="0 0 0" target="{} 0 0" up="0 {} 0"/>'):
        unit, long = (turned(step.format(length, length)).vertices for length in ("1", "1e300"))
        np.testing.assert_allclose(long, unit, atol=1e-12)
