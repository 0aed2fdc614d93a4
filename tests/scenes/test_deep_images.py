"""Images of more than 8 bits: of 16 bits a colour, which Pillow alone would cut to 8, and of fractions."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes.io.textures import load_texture, luminance, srgb_to_linear

COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}  # of PNG, by the number of channels


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def deep_png(levels: np.ndarray) -> bytes:
    """Make a PNG of (h, w, channels) levels of 16 bits, every row as differences from the pixel on its left."""
    height, width, channels = levels.shape
    content = levels.astype(">u2").view(np.uint8).reshape(height, width, 2 * channels)
    rows = np.diff(content, axis=1, prepend=np.uint8(0)).reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 16, COLOUR_TYPES[channels], 0, 0, 0)
    data = zlib.compress(b"".join(b"\x01" + row.tobytes() for row in rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("linear", [True, False])
@pytest.mark.parametrize("channels", COLOUR_TYPES)
def test_levels_of_16_bits_are_shares_of_65535(tmp_path: Path, channels: int, linear: bool) -> None:
    levels = np.random.default_rng(channels).integers(0, 1 << 16, (5, 7, channels))
    levels[0] = 1535  # 2.3 % of white, or 2.0 % by its upper byte
    (tmp_path / "deep.png").write_bytes(deep_png(levels))
    shares = levels / 65535
    colour = shares[..., :3] if channels > 2 else shares[..., :1].repeat(3, axis=2)
    expected = luminance(colour if linear else srgb_to_linear(colour))
    found = load_texture(tmp_path / "deep.png", linear=linear)
    np.testing.assert_allclose(found.image, expected, rtol=1e-5)
    if channels in (2, 4):
        alpha = load_texture(tmp_path / "deep.png", channel="alpha")
        np.testing.assert_allclose(alpha.image, shares[..., -1], rtol=1e-6)


def test_fractions_of_a_tif_are_linear_as_those_of_an_exr(tmp_path: Path) -> None:
    """They were taken as sRGB: half of white as 0.21 of it."""
    values = np.random.default_rng(1).random((4, 6), np.float32)
    Image.fromarray(values).save(tmp_path / "fractions.tif")
    np.testing.assert_array_equal(load_texture(tmp_path / "fractions.tif").image, values)
