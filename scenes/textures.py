"""Images from files, as the single-channel linear textures of a scene."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from scenes.errors import InputError
from scenes.files import silenced
from scenes.model import Texture

MAX_PIXELS = 1 << 26


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Rec. 709 luminance of linear RGB (..., 3): the one number this project keeps of a colour."""
    rgb = np.asarray(rgb)[..., :3]
    return rgb @ np.array([0.2126, 0.7152, 0.0722], dtype=np.result_type(rgb, np.float32))


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def load_texture(path: Path, *, linear: bool = False, channel: str = "luminance") -> Texture:
    """Read an image file (.png .jpg .bmp .tga .tif through Pillow, .exr through OpenEXR) as a linear texture.

    `linear` says that the numbers of an 8- or 16-bit file are linear already, else they are taken as sRGB (.exr is
    always linear). `channel` is "luminance", or "alpha" for the alpha channel (luminance where there is none).
    Raises InputError naming the file when it is missing, broken or of another type.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: texture file not found")
    if path.suffix.lower() == ".exr":
        return Texture(_exr_pixels(path, channel), path.name)
    return Texture(_image_pixels(path, linear, channel), path.name)


def _image_pixels(path: Path, linear: bool, channel: str) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(f"{path}: {image.width} x {image.height} pixels is over the limit of {MAX_PIXELS}")
            if image.mode in ("P", "PA", "CMYK", "YCbCr", "LAB", "HSV", "1"):
                image = image.convert("RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB")
            bands = image.getbands()
            values = np.asarray(image)
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(f"{path}: not an image this reader knows (.png .jpg .bmp .tga .tif .exr)") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: broken image file ({str(error).splitlines()[0]})") from None
    values = values.reshape(*values.shape[:2], -1)
    alpha = channel == "alpha" and bands[-1] == "A"
    values = values[..., -1:] if alpha else values[..., :3]
    if values.dtype in (np.uint8, np.uint16):
        # by table, in float32: a large image must not become many times its size
        levels = np.arange(np.iinfo(values.dtype).max + 1) / np.iinfo(values.dtype).max
        table = (levels if linear or alpha else srgb_to_linear(levels)).astype(np.float32)
        values = table[values]
    else:
        values = values / (65535 if bands == ("I",) else 1)
        values = values if linear or alpha else srgb_to_linear(values)
    if alpha:
        return values[..., 0]
    return luminance(values) if len(bands) >= 3 else values[..., 0]


def _exr_pixels(path: Path, channel: str) -> np.ndarray:
    import OpenEXR

    try:
        with silenced(), OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = {name: np.asarray(part.pixels, np.float64) for name, part in file.channels().items()}
    except Exception as error:  # OpenEXR raises bare exceptions of its own
        raise InputError(f"{path}: broken EXR file ({(str(error).splitlines() or ['no reason given'])[0]})") from None
    if channel == "alpha" and "A" in pixels:
        return pixels["A"]
    if {"R", "G", "B"} <= pixels.keys():
        return luminance(np.stack([pixels[name] for name in "RGB"], axis=-1))
    if "Y" in pixels:
        return pixels["Y"]
    raise InputError(f"{path}: channels {', '.join(sorted(pixels))}, expected R G B or Y")
