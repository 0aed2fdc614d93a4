"""Colours of mesh files as materials: every surface is diffuse, with the luminance of the file's colour as albedo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.errors import InputError, require
from scenes.io.inputs import read_bytes
from scenes.io.mesh_formats.glb import base_colours
from scenes.io.mesh_formats.mesh_files import read_material_library
from scenes.io.mesh_formats.mtl import MaterialEntry
from scenes.io.mesh_formats.obj import has_colours
from scenes.io.textures import (
    MAX_PIXELS,
    WHITE,
    Colour,
    image_values,
    load_texture,
    luminance,
    opened_image,
    srgb_to_linear,
)
from scenes.model import Material, Texture

if TYPE_CHECKING:
    from PIL import Image
    from trimesh.visual.base import Visuals
    from trimesh.visual.material import Material as TextureMaterial

Albedo = tuple[object, Callable[[], "float | Texture"]]  # a key, and what makes the albedo
DEFAULT_ALBEDO = 0.6


@dataclass(frozen=True)
class Part:
    """One geometry of the file in the world of the file: triangles still as the loader left them."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    normals: np.ndarray | None
    visual: Visuals | None
    colours: np.ndarray | None = None  # of a PLY or an STL, or beside the material of a GLB
    coloured: str = "vertex"  # what has them
    as_read: tuple[np.ndarray, np.ndarray] | None = None  # vertices and faces before any was dropped, as colours count
    image: Path | None = None  # of a PLY


class Paint:
    """The materials of a file: equal colours share one Material, equal images one Texture."""

    def __init__(self, path: Path, notes: list[str]) -> None:
        self.path, self.notes = path, notes
        kind = path.suffix.lower()
        self.library = read_material_library(path, notes) if kind == ".obj" else {}
        self.has_colours = kind == ".obj" and has_colours(read_bytes(path))  # per vertex
        self.base_colours = base_colours(read_bytes(path)) if kind == ".glb" else {}
        self.made: dict[object, Material] = {}

    def material(self, part: Part) -> Material:
        """Diffuse, with the part's texture or colour as albedo, 0.6 where the file says nothing."""
        try:
            key, make = self._albedo(part)
            if key not in self.made:
                self.made[key] = Material(albedo=make(), name=f"{part.name} paint")
        except InputError:
            raise
        except Exception as error:  # an image that decodes only now may be broken in many ways
            reason = (str(error).splitlines() or ["no reason given"])[0]
            raise InputError(f"{self.path}: broken colours of {part.name} ({reason})") from None
        return self.made[key]

    def coordinates(self, part: Part) -> np.ndarray | None:
        """Return the texture coordinates of a part, scaled and shifted as an OBJ's material says: uv * s + o."""
        source = getattr(part.visual, "material", None)
        if part.uv is None or source is None or self.path.suffix.lower() != ".obj":
            return part.uv
        entry = self.library.get(str(source.name), MaterialEntry())
        return part.uv * np.array(entry.uv_scale) + np.array(entry.uv_shift)

    def _albedo(self, part: Part) -> Albedo:
        """Return a key that tells the part's albedo from others, and a function that makes the albedo."""
        source = getattr(part.visual, "material", None)
        kind = self.path.suffix.lower()
        found: Albedo | float | None
        if kind == ".ply":
            found = self._ply_albedo(part)
        elif kind == ".stl":
            mean = self._mean_colour(part)
            found = None if mean is None else float(luminance(mean))
        elif source is None:
            found = self._vertex_colour(part)
        elif kind == ".obj":
            found = self._obj_albedo(part, str(source.name))
        else:
            found = self._glb_albedo(part, source)
        if self.has_colours and (source is not None or found is None):
            self.notes.append(f"{part.name}: its colours per vertex are left out")
        if isinstance(found, tuple):
            return found
        if found is None:
            found = DEFAULT_ALBEDO
            what = "no other colour in the file" if self.has_colours else "no colour in the file"
            if part.coloured == "some faces":
                what = "its colours of some faces are left out"
            self.notes.append(f"{part.name}: {what}, albedo {found:g}")
        value = round(min(max(float(found), 0.0), 1.0), 9)
        return value, lambda: value

    def _obj_albedo(self, part: Part, material: str) -> Albedo | float | None:
        entry = self.library.get(material, MaterialEntry())
        if entry.cut_out:
            self.notes.append(f"{part.name}: alpha (map_d) is left out, its surface is opaque")
        if entry.opacity < 1:
            self.notes.append(f"{part.name}: opacity {entry.opacity:g} is left out, its surface is opaque")
        image = entry.image
        if image is not None and self._is_mapped(part):
            note = f"material {material}: {entry.tint_note}"
            if entry.tint_note and note not in self.notes:
                self.notes.append(note)
            return (image, entry.tint), lambda: load_texture(image, tint=entry.tint)
        return None if entry.colour is None else float(luminance(np.array(entry.colour)))

    def _ply_albedo(self, part: Part) -> Albedo | float | None:
        image = part.image
        if image is not None and self._is_mapped(part):
            return image, lambda: _file_albedo(image)
        mean = self._mean_colour(part)
        return None if mean is None else float(luminance(mean))

    def _glb_albedo(self, part: Part, source: TextureMaterial) -> Albedo | float | None:
        image = getattr(source, "baseColorTexture", None) or getattr(source, "image", None)
        factor, mean = self._base_colour(source), self._mean_colour(part)
        tint = np.array(WHITE if factor is None else factor)
        tint *= 1 if mean is None else mean
        if getattr(source, "alphaMode", None) in ("MASK", "BLEND"):
            self.notes.append(f"{part.name}: alpha is left out, its surface is opaque")
        if image is not None and self._is_mapped(part):
            pixels = image.width * image.height
            message = f"{self.path}: the texture of {part.name} has {pixels} pixels, the limit is {MAX_PIXELS}"
            require(pixels <= MAX_PIXELS, message)
            return (id(image), tint.tobytes()), lambda: _image_albedo(image, tint)
        unknown = factor is None or (image is not None and factor == WHITE)
        return None if unknown and mean is None else float(luminance(tint))

    def _base_colour(self, source: TextureMaterial) -> Colour | None:
        """Return the linear base colour of a GLB's material; None of one that trimesh or this program made, without."""
        made = getattr(source, "baseColorFactor", None)
        without = None if made is None else tuple(np.asarray(made)[:3] / 255)
        return self.base_colours.get(str(source.name), without)

    def _is_mapped(self, part: Part) -> bool:
        """Return whether a part has texture coordinates, with a note where it has none for its image."""
        if part.uv is None:
            self.notes.append(f"{part.name}: its texture is left out, it has no texture coordinates")
        return part.uv is not None

    def _mean_colour(self, part: Part) -> np.ndarray | None:
        """Average the colours (3,), linear, that a part has per vertex beside its material; None where it has none."""
        if part.colours is None:
            return None
        colours = part.colours[:, :3]
        most = np.iinfo(colours.dtype).max if colours.dtype.kind in "iu" else 1
        colours = np.clip(colours / most, 0, 1)
        self.notes.append(f"{part.name}: one mean albedo in place of its colours per {part.coloured}")
        linear = colours if self.path.suffix.lower() == ".glb" else srgb_to_linear(colours)
        return np.asarray(np.average(linear, axis=0, weights=_areas(part, part.coloured, len(colours))))

    def _vertex_colour(self, part: Part) -> float | None:
        """Average the colours stored per vertex or face (linear in glTF, sRGB elsewhere); None where there are none."""
        visual = part.visual
        kind = getattr(visual, "kind", None)
        if visual is None or kind not in ("vertex", "face"):
            return None
        colours = np.asarray(visual.vertex_colors if kind == "vertex" else visual.face_colors)[:, :3] / 255
        self.notes.append(f"{part.name}: one mean albedo in place of its colours per {kind}")
        bright = luminance(colours if self.path.suffix.lower() == ".glb" else srgb_to_linear(colours))
        return float(np.average(bright, weights=_areas(part, kind, len(colours))))


def _areas(part: Part, coloured: str, colours: int) -> np.ndarray | None:
    """Return the area that each vertex or face has colour on, (colours,): a third of a face at each of its corners.

    None, for a plain mean, where it is not known which face has which colour, as of polygons, or all areas are 0.
    """
    if part.as_read is None:
        return None
    vertices, faces = part.as_read
    a, b, c = vertices[faces].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    if coloured == "vertex":
        areas = np.bincount(faces.ravel(), np.repeat(areas / 3, 3), len(vertices))
    return areas if len(areas) == colours and areas.any() else None


def _file_albedo(path: Path) -> Texture:
    """Return the texture of an sRGB image in a file."""
    with opened_image(path, "texture") as image:
        return _image_albedo(image, np.ones(3))


def _image_albedo(image: Image.Image, tint: np.ndarray) -> Texture:
    """Return the texture of an sRGB image held in memory, times a linear colour."""
    values = image_values(image)
    made = np.empty(values.shape[:2], np.float32)
    for row in range(0, len(values), 64):  # a few at a time: in double precision an image takes 100 bytes a pixel
        made[row : row + 64] = np.clip(luminance(values[row : row + 64] * tint), 0.0, 1.0)
    return Texture(made, "base colour")
