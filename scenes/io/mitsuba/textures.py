"""Mitsuba's texture plugins as textures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes.errors import InputError
from scenes.io.mitsuba.nodes import Document
from scenes.io.mitsuba.plugin import Plugin
from scenes.io.textures import load_texture, with_sharp_texels
from scenes.model import Texture

CHECKERBOARD_PIXELS = 256
_UNREAD = Texture(np.full((1, 1), 0.5), "unread")


class Uv:
    """The one texture transform that all textures of a material must share, since a mesh has one set of uv."""

    def __init__(self) -> None:
        self.matrix: np.ndarray | None = None

    def agree(self, plugin: Plugin, matrix: np.ndarray) -> None:
        if self.matrix is not None and not np.allclose(self.matrix, matrix):
            raise plugin.fail("two textures of one material have different to_uv, expected the same")
        self.matrix = matrix


class Textures:
    """Reads every image once.

    With `reads_images` false every image is one grey pixel: what cannot be taken then shows before images are read.
    """

    def __init__(self, document: Document, *, reads_images: bool = True) -> None:
        self._document = document
        self._reads_images = reads_images
        self._images: dict[tuple[Path, bool, str, bool], Texture] = {}
        self._sharp: dict[int, Texture] = {}  # by the id of the image that is enlarged

    def fraction(self, plugin: Plugin, name: str, default: float, uv: Uv) -> float | Texture:
        """Return a reflectance or opacity: a number or a texture, clipped at 1 with a note."""
        nested = plugin.nested_as(name)
        if nested is None:
            return clipped(plugin, name, plugin.colour(name, default))
        texture, matrix = self.texture(nested)
        uv.agree(plugin, matrix)
        if texture.image.max() > 1:
            plugin.note(f"{name} over 1 is clipped to 1")
            texture = replace(texture, image=np.minimum(texture.image, 1))
        return texture

    def mean(self, plugin: Plugin, name: str, default: float) -> float:
        """Return a number, or the mean of a texture where the model has no room for one."""
        nested = plugin.nested_as(name)
        if nested is None:
            return plugin.colour(name, default)
        plugin.note(f"{name} has a texture, its mean is used")
        return float(self.texture(nested)[0].image.mean(dtype=np.float64))

    def texture(self, plugin: Plugin) -> tuple[Texture, np.ndarray]:
        """Return a texture and its uv transform (3x3, Mitsuba's v)."""
        if plugin.tag != "texture":
            raise plugin.fail("expected a texture here")
        if plugin.type == "bitmap":
            texture = self._bitmap(plugin)
        elif plugin.type == "checkerboard":
            texture = _checkerboard(plugin)
        else:
            raise plugin.fail(f"texture {plugin.type!r} is not supported, bake it into a bitmap or checkerboard")
        matrix = plugin.texture_transform()
        plugin.note_unused()
        return texture, matrix

    def _bitmap(self, plugin: Plugin) -> Texture:
        plugin.ignore(("max_anisotropy", "cache", "format"))
        wrap = plugin.string("wrap_mode", "repeat")
        if wrap not in ("repeat", "clamp"):
            plugin.note(f"wrap_mode {wrap} is taken as repeat")
        chosen, channel = plugin.string("channel", "all"), "luminance"
        if chosen == "a":  # of version 0.6; else Mitsuba leaves alpha out, of opacities too
            channel = "alpha"
        elif chosen != "all":
            plugin.note(f"channel {chosen} of the image is taken as its luminance")
        linear = plugin.boolean("raw", False) or plugin.number("gamma", 0.0) == 1
        path = self._document.file(plugin.element, plugin.string("filename"), "texture")
        read = self.image(path, linear, channel, clamps=wrap == "clamp")
        if plugin.string("filter_type", "bilinear") == "nearest" and self._reads_images:
            return self._with_sharp_texels(plugin, read)
        return read

    def _with_sharp_texels(self, plugin: Plugin, read: Texture) -> Texture:
        """Return a texture that is looked up by the nearest texel: each one enlarged, as lookup is bilinear here."""
        if id(read) not in self._sharp:
            self._sharp[id(read)] = with_sharp_texels(read)
        if self._sharp[id(read)] is read and read.image.size > 1:
            plugin.note("filter_type nearest is taken as bilinear, as the image is large")
        return self._sharp[id(read)]

    def image(self, path: Path, linear: bool, channel: str, *, clamps: bool = False) -> Texture:
        """Return a texture file, read once."""
        key = (path.resolve(), linear, channel, clamps)
        if key not in self._images:
            read = load_texture(path, linear=linear, channel=channel) if self._reads_images else _UNREAD
            self._images[key] = replace(read, clamps=clamps)
        return self._images[key]


def clipped(plugin: Plugin, name: str, value: float) -> float:
    """Return a share, 1 at most, with a note where that changes it."""
    if value > 1 + 1e-9:
        plugin.note(f"{name} over 1 is clipped to 1")
    return min(value, 1.0)


def _checkerboard(plugin: Plugin) -> Texture:
    """Two by two squares over the unit square, color0 at the origin."""
    dark, light = plugin.colour("color0", 0.4), plugin.colour("color1", 0.2)
    half = np.ones((CHECKERBOARD_PIXELS // 2, CHECKERBOARD_PIXELS // 2))
    try:
        return Texture(np.kron([(dark, light), (light, dark)], half), "checkerboard")
    except InputError as error:
        raise plugin.fail(str(error)) from None
