"""Images from files, as the single-channel linear textures of a scene."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.errors import InputError, require
from scenes.files import silenced
from scenes.io.inputs import regular_file
from scenes.model import Texture

if TYPE_CHECKING:
    from PIL import Image

Colour = tuple[float, float, float]  # linear RGB
WHITE: Colour = (1.0, 1.0, 1.0)
MAX_PIXELS = 1 << 26
SHARP_PIXELS = 1024  # side up to which images without interpolation are enlarged
# By Pillow's name of a layout of 16 bits a colour, the one under which it keeps the lower bytes.
_LOWER_BYTES = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L", "LA;16B": "RGBA"}
MAX_EXR_VALUES = 1 << 27  # of all channels: 8192 x 4096 RGBA, 1 GiB as float64


def luminance(rgb: np.ndarray, tint: Colour = WHITE) -> np.ndarray:
    """Return Rec. 709 luminance of linear RGB (..., 3), times `tint`: the one number this project keeps of it."""
    rgb = np.asarray(rgb)[..., :3]
    weights = np.array([0.2126, 0.7152, 0.0722]) * tint
    return rgb @ weights.astype(np.result_type(rgb, np.float32))


def _tinted(grey: np.ndarray, tint: Colour) -> np.ndarray:
    """Multiply a grey image by a colour's luminance."""
    return grey if tint == WHITE else grey * luminance(np.array(tint, np.float32))


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Return linear light of sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def load_texture(path: Path, *, linear: bool = False, channel: str = "luminance", tint: Colour = WHITE) -> Texture:
    """Read an image file (.png .jpg .bmp .tga .tif through Pillow, .exr through OpenEXR) as a linear texture.

    `linear` says that the numbers of an 8- or 16-bit file are linear already, else they are taken as sRGB (.exr is
    always linear, and so are fractions in a .tif). `channel` is "luminance", or "alpha" for the alpha channel
    (luminance where there is none).
    `tint` is a linear colour that the image is multiplied by.
    Raises InputError naming the file when it is missing, broken or of another type.
    """
    path = regular_file(path, "texture file")
    if path.suffix.lower() == ".exr":
        return Texture(_exr_pixels(path, channel, tint), path.name)
    return Texture(_image_pixels(path, linear, channel, tint), path.name)


def with_sharp_texels(texture: Texture) -> Texture:
    """Return a texture whose texels have edges, as looked up by the nearest texel: each becomes a square of equal ones.

    Lookup interpolates everywhere in this project; it then blends over one part in SHARP_PIXELS of the image. An image
    of more than half as many pixels a side comes back as it is.
    """
    factor = SHARP_PIXELS // max(texture.image.shape)
    if factor < 2:
        return texture
    return replace(texture, image=np.kron(texture.image, np.ones((factor, factor), np.float32)))


def _image_pixels(path: Path, linear: bool, channel: str, tint: Colour) -> np.ndarray:
    with opened_image(path) as image:
        values = image_values(image, linear=linear, channel=channel)
    return luminance(values, tint) if values.shape[2] == 3 else _tinted(values[..., 0], tint)


def image_values(image: Image.Image, *, linear: bool = False, channel: str = "luminance") -> np.ndarray:
    """Return an opened image's linear colour, (h, w, 3), or (h, w, 1) where it is grey or its alpha is asked for.

    Levels of 8 and 16 bits are shares of the most that they can be. `linear` and `channel` are as in `load_texture`.
    """
    if image.mode in ("P", "PA", "CMYK", "YCbCr", "LAB", "HSV", "1"):
        image = image.convert("RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB")
    bands = image.getbands()
    values = _levels_of_16_bits(image)
    values = np.asarray(image) if values is None else values
    values = values.reshape(*values.shape[:2], -1)
    alpha = channel == "alpha" and bands[-1] == "A"
    values = values[..., -1:] if alpha else values[..., : 3 if values.shape[2] >= 3 else 1]
    if values.dtype in (np.uint8, np.uint16):
        # by table, in float32: a large image must not become many times its size
        levels = np.arange(np.iinfo(values.dtype).max + 1) / np.iinfo(values.dtype).max
        table = (levels if linear or alpha else srgb_to_linear(levels)).astype(np.float32)
        return table[values]
    linear = linear or values.dtype.kind == "f"  # as fractions are in all formats that have them
    values = values / (65535 if bands == ("I",) else 1)
    return values if linear or alpha else srgb_to_linear(values)


def _levels_of_16_bits(image: Image.Image) -> np.ndarray | None:
    """Return all bits (h, w, channels) of a PNG of 16 bits a colour; None of another image, or one decoded already.

    Pillow drops the lower byte of such colours: one of 2 % of white loses a sixth. Other names of the layout of the
    same bytes give it.
    """
    from PIL.PngImagePlugin import PngImageFile

    if not isinstance(image, PngImageFile) or not image.tile or image.fp is None:
        return None
    layout = image.tile[0].args
    if not isinstance(layout, str) or layout not in _LOWER_BYTES:
        return None
    at = image.fp.tell()
    image.fp.seek(0)
    content = io.BytesIO(image.fp.read())
    image.fp.seek(at)
    with PngImageFile(content) as other:
        other.tile = [other.tile[0]._replace(args=_LOWER_BYTES[layout])]
        lower = np.asarray(other)
    if layout == "LA;16B":  # both bytes of both channels
        return lower[..., ::2].astype(np.uint16) << 8 | lower[..., 1::2]
    return np.asarray(image).astype(np.uint16) << 8 | lower


@contextmanager
def opened_image(path: Path, what: str = "image file") -> Iterator[Image.Image]:
    """Open an image through Pillow, its declared size and checksums checked before any pixel is decoded.

    What goes wrong while its pixels are taken is an InputError too, in one line that names the file.
    """
    from PIL import Image

    path = regular_file(path, what)
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            size = image.width, image.height
            require(size[0] * size[1] <= MAX_PIXELS, f"{size[0]} x {size[1]} pixels is over the limit of {MAX_PIXELS}")
            check_checksums(image)
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            yield image
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Image.UnidentifiedImageError:
        raise InputError(f"{path}: not an image this reader knows (.png .jpg .bmp .tga .tif .exr)") from None
    except Exception as error:  # each of Pillow's formats has its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: broken image file ({reason[:160]})") from None


def check_checksums(image: Image.Image) -> None:
    """Raise SyntaxError or OSError where a chunk of a PNG does not fit its CRC-32; `image` must be opened again then.

    Pillow skips those of the pixels when it decodes them, and keeps what it has where their stream ends in an error.
    """
    if image.format == "PNG":
        image.verify()


def exr_channels(path: Path, what: str = "image file") -> dict[str, np.ndarray]:
    """Return the channels of a flat EXR, float64, by name, its declared size checked before any pixel is decoded."""
    channels, _ = read_flat_exr(path, what)
    with np.errstate(invalid="ignore"):  # of signalling NaNs, which stay what they are
        return {name: np.asarray(pixels, np.float64) for name, pixels in channels.items()}


def read_flat_exr(path: Path, what: str = "image file") -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read a flat EXR's channels by name, and its header; the declared size is checked before any pixel is decoded.

    Raises InputError naming the file where it is missing, broken or too large.
    """
    import OpenEXR

    path = regular_file(path, what)
    try:
        with silenced():  # OpenEXR reports damage on stdout
            with OpenEXR.File(str(path), header_only=True) as file:
                low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
                channels = len(file.header()["channels"])
            wide, tall = (high - low + 1).tolist()
            require(wide > 0 and tall > 0, f"data window of {wide} x {tall} pixels")
            values = wide * tall * channels
            message = f"{wide} x {tall} pixels of {channels} channels are over the limit of {MAX_EXR_VALUES} values"
            require(values <= MAX_EXR_VALUES, message)
            with OpenEXR.File(str(path), separate_channels=True) as file:
                return {name: part.pixels for name, part in file.channels().items()}, dict(file.header())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # OpenEXR raises bare exceptions of its own
        raise InputError(f"{path}: broken EXR file ({(str(error).splitlines() or ['no reason given'])[0]})") from None


def _exr_pixels(path: Path, channel: str, tint: Colour) -> np.ndarray:
    pixels = exr_channels(path, "texture file")
    if channel == "alpha" and "A" in pixels:
        return pixels["A"]
    if {"R", "G", "B"} <= pixels.keys():
        return luminance(np.stack([pixels[name] for name in "RGB"], axis=-1), tint)
    if "Y" in pixels:
        return _tinted(pixels["Y"], tint)
    raise InputError(f"{path}: channels {', '.join(sorted(pixels))}, expected R G B or Y")
