"""Material libraries of .obj files: images times colours, options of images, and names that are defined nowhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from scenes import InputError, Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.textures import luminance, srgb_to_linear
from scenes.placing import Placing

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
PIXELS = np.random.default_rng(1).integers(0, 256, (4, 4, 3), dtype=np.uint8)
LINEAR = srgb_to_linear(PIXELS / 255)
SIZE_KEPT = "largest extent 1 m kept"


def load(folder: Path, library: str, faces: str = f"usemtl oak\n{FACE}", image: str = "w.png") -> Scene:
    """Return the scene of a square whose material file is `library`, beside an image."""
    if image.endswith(".exr"):
        channels = {"RGB": LINEAR.astype(np.float32)}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(str(folder / image))
    else:
        Image.fromarray(PIXELS).save(folder / image)
    (folder / "a.mtl").write_text(library)
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{QUAD}{faces}")
    return load_mesh(folder / "a.obj", placing=Placing(scale=1, bare=True))


def albedo(scene: Scene) -> np.ndarray:
    return scene.surfaces[0].material.albedo.image


@pytest.mark.parametrize("image", ["w.png", "w.exr"])
def test_an_image_is_multiplied_by_its_colour(tmp_path: Path, image: str) -> None:
    """In linear light, each channel by its own: the luminance of the product is not the product of luminances."""
    colour = (1.0, 0.25, 0.5)
    scene = load(tmp_path, f"newmtl oak\nKd 1 0.25 0.5\nmap_Kd {image}\n", image=image)
    np.testing.assert_allclose(albedo(scene), luminance(LINEAR * colour), rtol=1e-5)
    assert scene.notes == ("material oak: map_Kd is multiplied by its Kd, 1 0.25 0.5", SIZE_KEPT)[::-1]


def test_a_grey_image_is_multiplied_by_the_luminance_of_its_colour(tmp_path: Path) -> None:
    Image.fromarray(PIXELS[..., 0]).save(tmp_path / "grey.png")
    scene = load(tmp_path, "newmtl oak\nKd 1 0.25 0.5\nmap_Kd grey.png\n")
    np.testing.assert_allclose(albedo(scene), LINEAR[..., 0] * luminance(np.array((1, 0.25, 0.5))), rtol=1e-5)


@pytest.mark.parametrize(
    ("line", "note"),
    [
        ("", ()),
        ("Kd 1 1 1\n", ()),
        ("Kd 1\n", ()),
        ("Kd 0 0 0\n", ("material oak: map_Kd is taken alone, not multiplied by its black Kd",)),
    ],
)
def test_an_image_is_taken_alone_beside_white_none_and_black(tmp_path: Path, line: str, note: tuple) -> None:
    scene = load(tmp_path, f"newmtl oak\n{line}map_Kd w.png\n")
    np.testing.assert_allclose(albedo(scene), luminance(LINEAR), rtol=1e-5)
    assert scene.notes == (SIZE_KEPT, *note)


def test_one_image_in_two_colours_makes_two_textures_and_a_note_each(tmp_path: Path) -> None:
    library = "newmtl oak\nKd 0.5 0.5 0.5\nmap_Kd w.png\nnewmtl ash\nKd 0.25 0.25 0.25\nmap_Kd w.png\n"
    faces = "usemtl oak\nf 1/1 2/2 3/3\nusemtl ash\nf 1/1 3/3 4/4\n"
    scene = load(tmp_path, library, faces)
    found = {surface.name: surface.material.albedo.image for surface in scene.surfaces}
    np.testing.assert_allclose(found["oak"], 2 * found["ash"], rtol=1e-6)
    assert sum("multiplied" in note for note in scene.notes) == 2


@pytest.mark.parametrize(
    "options",
    ["-s 1 1 1", "-s 1", "-o 0 0 0 -s 1 1", "-t 0 -blendu on -clamp off", "-mm 0.0 1.0", "-texres 512", "-S 1 1 1"],
)
@pytest.mark.parametrize("name", ["w.png", "my own.png"])
def test_options_that_change_nothing_are_read_over(tmp_path: Path, options: str, name: str) -> None:
    scene = load(tmp_path, f"newmtl oak\nmap_Kd {options} {name}\n", image=name)
    np.testing.assert_allclose(albedo(scene), luminance(LINEAR), rtol=1e-5)
    assert scene.notes == (SIZE_KEPT,)


@pytest.mark.parametrize(
    ("options", "scale", "shift"),
    [
        ("-s 2 2 1", (2, 2), (0, 0)),
        ("-s 2", (2, 1), (0, 0)),
        ("-o 0.5 0.25 0", (1, 1), (0.5, 0.25)),
        ("-S 0.5 4 -o -1 0.125", (0.5, 4), (-1, 0.125)),
        ("-o 1 -s -1 1", (-1, 1), (1, 0)),
    ],
)
def test_scale_and_shift_of_an_image_move_its_coordinates(tmp_path: Path, options: str, scale, shift) -> None:
    plain = load(tmp_path, "newmtl oak\nmap_Kd w.png\n").surfaces[0]
    moved = load(tmp_path, f"newmtl oak\nmap_Kd -blendu on {options} w.png\n").surfaces[0]
    np.testing.assert_allclose(moved.uv, plain.uv * np.array(scale) + np.array(shift), rtol=1e-12)
    np.testing.assert_array_equal(moved.vertices, plain.vertices)


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("-t 0.1 0.1 0.1", "is not read; bake it into the image"),
        ("-s inf 1 1", "expected finite numbers"),
        ("-o 0 nan 0", "expected finite numbers"),
    ],
)
def test_what_cannot_be_read_of_an_image_is_refused(tmp_path: Path, option: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, f"newmtl oak\nmap_Kd -blendu on {option} w.png\n")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'a.mtl'}: map_Kd of material oak: option {option}")
    assert message.endswith(why) and "\n" not in message


@pytest.mark.parametrize("option", ["-mm 0.2 0.5", "-clamp on", "-cc on", "-glow"])
def test_other_options_are_left_out_with_a_note(tmp_path: Path, option: str) -> None:
    scene = load(tmp_path, f"newmtl oak\nmap_Kd {option} w.png\n")
    np.testing.assert_allclose(albedo(scene), luminance(LINEAR), rtol=1e-5)
    assert f"material oak: option {option} of map_Kd is left out" in scene.notes


@pytest.mark.parametrize("colour", ["nan 0 0", "0.5 0.5", "inf"])
def test_a_colour_that_is_no_number_is_refused(tmp_path: Path, colour: str) -> None:
    with pytest.raises(InputError, match=rf"a\.mtl: Kd '{colour}', expected three numbers$"):
        load(tmp_path, f"newmtl oak\nKd {colour}\n")


def test_materials_that_are_defined_nowhere_are_noted_by_name(tmp_path: Path) -> None:
    faces = f"usemtl oak\n{FACE}usemtl my ash\r\n{FACE}  usemtl\told elm\n{FACE}usemtl my ash\n{FACE}# usemtl fir\n"
    notes = load(tmp_path, "newmtl oak\nKd 0.5 0.5 0.5\n", faces).notes
    assert "usemtl names what no material file defines: my ash, old elm" in notes


def test_materials_that_are_defined_are_not_noted(tmp_path: Path) -> None:
    assert load(tmp_path, "newmtl oak\nKd 0.5 0.5 0.5\n").notes == (SIZE_KEPT,)


def test_metal_glow_and_clipped_colours_are_noted_in_a_line_each(tmp_path: Path) -> None:
    glowing = "".join(f"newmtl {name}\nKd 0.5 0.5 2\nKe 0 3 0\nPm 1\n" for name in ("oak", "elm"))
    dark = "newmtl ash\nKd 0.5 0.5 0.5\nKe 0 0 0\nPm 0\n"
    assert load(tmp_path, glowing + dark).notes[-3:] == (
        "Kd outside 0 to 1 is clipped: oak, elm",
        "Ke is left out, its surfaces give no light: oak, elm",
        "Pm is left out, its surfaces are diffuse: oak, elm",
    )
    assert not any(word in note for note in load(tmp_path, dark).notes for word in ("Kd", "Ke", "Pm"))


@pytest.mark.parametrize("line", ["map_Bump -bm 0.5 bumps.png", "bump bumps.png", "norm n.png", "disp d.png"])
def test_bumps_are_noted(tmp_path: Path, line: str) -> None:
    key = line.split()[0]
    notes = load(tmp_path, f"newmtl oak\nKd 0.5 0.5 0.5\n{line}\n").notes
    assert f"{key} is left out, its surfaces keep their own shape: oak" in notes
