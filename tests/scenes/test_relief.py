"""RGB-D reliefs: dequantising, holes, cuts, and depth in every pixel."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from render.transient import read_transient
from scene2spad.cli import main
from scenes import InputError, Texture
from scenes.io.relief import RgbdFiles, dequantised, filled, middlebury, middlebury_names, read_levels, relief, rgbd

GREY = Texture(np.full((40, 60), 0.4, np.float32), "grey")


def layers(scene):
    from render.direct.integrator import centre_layers
    from render.scene.traced_scene import TracedScene

    found = centre_layers(TracedScene(scene))
    shape = scene.camera.height, scene.camera.width
    axial = (scene.camera.rays() @ scene.camera.rotation)[..., 2]
    return found.depth_m.reshape(shape) * axial, found


@pytest.mark.parametrize("slope", [(0.03, 0.0), (0.21, -0.11), (-0.4, 0.07)])
def test_dequantising_finds_the_plane_between_its_steps(slope):
    y, x = np.mgrid[:60, :80]
    plane = 100 + slope[0] * x + slope[1] * y
    smooth = dequantised(np.rint(plane))
    assert np.abs(smooth - np.rint(plane)).max() < 0.5
    inner = np.abs(smooth - plane)[12:-12, 12:-12]
    assert inner.mean() < 0.4 * np.abs(np.rint(plane) - plane).mean()
    wanted = np.abs(slope[0])
    assert np.abs(np.diff(smooth, axis=1)[12:-12, 12:-12] - slope[0]).mean() < max(0.35 * wanted, 0.03)


def test_dequantising_leaves_edges_where_they_are():
    levels = np.where(np.arange(80) < 40, 100.0, 160.0) * np.ones((50, 1))
    assert dequantised(levels) == pytest.approx(levels)


def test_holes_are_filled_from_the_farther_side():
    levels = np.array([[5, 0, 0, 9], [0, 0, 0, 0], [0, 7, 0, 0]], float)
    assert filled(levels, levels > 0, near_is_high=True).tolist() == [[5, 5, 5, 9], [5, 5, 5, 9], [7, 7, 7, 7]]
    assert filled(levels, levels > 0, near_is_high=False)[0].tolist() == [5, 9, 9, 9]


def test_depth_edges_are_cut_and_nothing_gapes_or_stretches():
    """A step of 1 m: every pixel has its own depth, and none something in between."""
    depth = np.where(np.arange(60) < 31, 2.0, 3.0) * np.ones((40, 1))
    scene = relief("step", depth, GREY, 60.0)
    axial, _ = layers(scene)
    assert axial == pytest.approx(depth, abs=1e-5)
    for width in (47, 203):
        seen, _ = layers(replace(scene, camera=scene.camera.resized(width)))
        assert np.isfinite(seen).all() and np.isin(np.round(seen, 4), (2.0, 3.0)).all()


def test_a_steep_slope_is_not_cut():
    depth = 2 + 0.05 * np.arange(60) * np.ones((40, 1))  # 1.5 to 2.5 pixels deep for one to the side
    axial, _ = layers(relief("slope", depth, GREY, 60.0))
    assert axial == pytest.approx(depth, rel=1e-3)


def test_border_pixels_have_their_own_colour_alone():
    """Bright on the left and black on the right: a texture that repeats lends each border an eighth of the other."""
    from render.engine import render
    from render.settings import RenderSettings

    halves = Texture(np.tile(np.where(np.arange(20) < 10, 0.8, 0.0), (15, 1)), "halves")
    transient = render(relief("halves", np.full((15, 20), 2.0), halves, 20.0), RenderSettings(bounces=1, grid=4))
    seen = (transient.total_radiance() * transient.depth_m.astype(float) ** 2)[[0, 7, -1]]
    assert seen[:, :8] == pytest.approx(np.full((3, 8), seen[1, 3]), rel=1e-3)
    assert np.abs(seen[:, -8:]).max() == 0


def test_the_cosine_is_a_switch():
    from render.engine import render
    from render.settings import RenderSettings

    depth = 2 + 0.02 * np.arange(60) * np.ones((40, 1))
    settings = RenderSettings(bounces=1, grid=4)
    plain, shaded = (render(relief("slope", depth, GREY, 60.0, cosine=cosine), settings) for cosine in (False, True))
    scene = relief("slope", depth, GREY, 60.0)
    distance, intensity = plain.depth_m.astype(float), scene.laser.intensity(scene.camera)
    inner = (slice(2, -2), slice(2, -2))
    expected = 0.4 * intensity / (np.pi * distance**2)
    assert plain.total_radiance()[inner] == pytest.approx(expected[inner], rel=0.01)
    rays = scene.camera.rays()
    # the slope's own normal: dz = 0.02 a pixel, a pixel is z / 60 wide
    z = depth
    x = (np.arange(60) + 0.5 - 30) / 60
    along_x = np.stack((z / 60 + x * 0.02, 0 * z, -0.02 + 0 * z), axis=-1)
    along_y = np.stack((0 * z, z / 60, 0 * z), axis=-1)
    normal = np.cross(along_x, along_y)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = np.abs((normal * rays).sum(axis=-1))
    assert shaded.total_radiance()[inner] == pytest.approx((expected * cosine)[inner], rel=0.02)


def test_a_users_pair_has_its_depth_scale_and_focal_length(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((30, 40), 188, np.uint8)).save(tmp_path / "photo.png")
    level = np.full((30, 40), 1500, np.uint16)
    level[10:12, 10:12] = 0
    Image.fromarray(level).save(tmp_path / "depth.png")
    scene = rgbd(RgbdFiles(tmp_path / "photo.png", tmp_path / "depth.png", focal_px=50.0, scale_m=1e-3))
    assert scene.camera.focal_px == pytest.approx(50) and scene.name == "photo"
    assert layers(scene)[0] == pytest.approx(1.5, abs=6e-4)
    assert scene.surfaces[0].material.albedo.image == pytest.approx(((188 / 255 + 0.055) / 1.055) ** 2.4)
    assert any("holes: 0.33%" in note for note in scene.notes)


def test_middlebury_reliefs_keep_their_disparities(shared_data, monkeypatch):
    """At least 95 % of the known pixels within half a level of disp1."""
    monkeypatch.setenv("SCENE2SPAD_DATA", str(shared_data))
    assert len(middlebury_names()) == 5
    folder = shared_data / "middlebury" / "Art"
    scene = middlebury(folder)
    assert scene.camera.fov_deg == pytest.approx(21.05, abs=0.05)
    axial, _ = layers(scene)
    levels = read_levels(folder / "disp1.png")
    known = levels > 0
    off = np.abs(3740 * 0.160 / axial - float((folder / "dmin.txt").read_text()) - levels)[known]
    assert (off <= 0.5).mean() >= 0.95 and np.isfinite(axial).all()


def test_depth_images_of_a_palette_are_its_colours(tmp_path):
    """A palette in any order, as image optimisers make it."""
    from PIL import Image

    levels = np.arange(1, 13, dtype=np.uint8).reshape(3, 4)
    image = Image.fromarray(12 - levels)
    image.putpalette([value for index in range(256) for value in (max(12 - index, 0),) * 3])
    image.save(tmp_path / "depth.png")
    with Image.open(tmp_path / "depth.png") as saved:
        assert saved.mode == "P"
    assert (read_levels(tmp_path / "depth.png") == levels).all()


def test_depth_images_of_16_bits_in_several_channels_are_refused(tmp_path):
    """Pillow would read their upper 8 bits."""
    levels = np.repeat(np.array([[1000, 2000], [3000, 4000]], ">u2")[..., None], 3, axis=-1)
    rows = b"".join(b"\0" + row.tobytes() for row in levels)
    parts = ((b"IHDR", struct.pack(">IIBBBBB", 2, 2, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    chunks = [struct.pack(">I", len(d)) + name + d + struct.pack(">I", zlib.crc32(name + d)) for name, d in parts]
    (tmp_path / "depth.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(InputError, match=r"^[^\n]*depth\.png: 16 bits in 3 channels[^\n]*$"):
        read_levels(tmp_path / "depth.png")


@pytest.mark.parametrize(("options", "size"), [((), (20, 15)), (("--height", "6"), (8, 6)), (("--width", "4"), (4, 3))])
def test_a_pair_is_rendered_at_the_size_of_its_depth_image(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], size: tuple[int, int]
) -> None:
    """The photograph may be larger; one of width and height keeps the proportions."""
    Image.fromarray(np.full((30, 40), 188, np.uint8)).save(tmp_path / "photo.png")
    Image.fromarray(np.full((15, 20), 2000, np.uint16)).save(tmp_path / "depth.png")
    pair = ["render", str(tmp_path / "photo.png"), "--depth", str(tmp_path / "depth.png"), "--focal", "20"]
    out = tmp_path / "a.exr"
    rest = ["--depth-scale", "0.001", "--bounces", "1", "--grid", "1", "--no-figure", "--out", str(out)]
    assert main([*pair, *rest, *options]) == 0
    capsys.readouterr()
    assert read_transient(out).depth_m.shape == size[::-1]
