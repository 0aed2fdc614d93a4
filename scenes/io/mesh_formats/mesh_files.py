"""Mesh files by way of trimesh, and material libraries: what they declare is checked first, what they name lies in
their folder."""

from __future__ import annotations

import codecs
import io
import logging
import re
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from scenes.errors import InputError, listed, require
from scenes.io.inputs import file_inside, read_bytes
from scenes.io.mesh_formats import NotReadError
from scenes.io.mesh_formats.glb import check_glb, plain_glb
from scenes.io.mesh_formats.mtl import MaterialEntry, lenient_text, read_library, without_mark
from scenes.io.mesh_formats.obj import alike_obj, obj_fault, plain_colours, plain_obj
from scenes.io.mesh_formats.polygons import without_dents
from scenes.io.mesh_formats.stl import plain_stl

if TYPE_CHECKING:
    import trimesh

MAX_COORDINATE = 1e12  # in the file's unit: squares and cross products of such stay finite in double precision
MAX_TRIANGLES = 1 << 25  # with all instances: a scene's arrays take some 200 bytes a triangle
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # without one, its tracebacks go to stderr
MAGIC = {b"ply": ".ply", b"glTF": ".glb", b"solid": ".stl"}


class _Beside:
    """Files beside a mesh, for trimesh: regular ones inside the mesh's folder alone.

    Those of a .glb are named by URIs, in which %20 stands for a blank; not all programs write it so.
    """

    def __init__(self, path: Path) -> None:
        self.folder, self.file_name = path.parent, path.name  # trimesh names geometry by the file
        self.made: dict[str, bytes] = {}  # what is there in place of files
        self.textured = False  # whether a material library names an image of colours

    def get(self, name: str) -> bytes:
        name = name.strip()
        if name in self.made:
            return self.made[name]
        decoded = unquote(name) if self.file_name.lower().endswith(".glb") else name
        try:
            return read_bytes(file_inside(self.folder, decoded))
        except InputError:
            if decoded == name:
                raise
            return read_bytes(file_inside(self.folder, name))

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)


def load_trimesh(path: Path, kind: str, **options: bool) -> trimesh.Scene:
    """Return the trimesh.Scene of a file as it is: nothing merged, removed or reordered.

    kind     ".obj", ".stl" or ".glb"
    options  handed to trimesh

    Raises InputError in one line that begins with the file where it is missing, cut short, not consistent with what it
    declares, or refers to what is not there.
    """
    import trimesh

    content = original = without_mark(read_bytes(path, "mesh file"))
    beside = _Beside(path)
    try:
        content, triangles = _checked(content, kind, beside)
        if kind == ".obj" and options.get("skip_materials") and b"\nvn " not in content:
            # trimesh parts a mesh where materials change, and normals that are made would have a crease there
            content = re.sub(rb"^usemtl.*", b"", content, flags=re.MULTILINE)
        if kind == ".obj":
            if not options.get("skip_materials"):  # as for Mitsuba, which cuts fans
                content = without_dents(plain_colours(content, beside.textured))
            content, options["split_groups"] = alike_obj(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = trimesh.load_scene(
                io.BytesIO(content),
                file_type=kind[1:],
                resolver=beside,
                process=False,
                **options,
            )
        if any(np.shape(getattr(mesh, "vertices", [(0, 0, 0)]))[1:] != (3,) for mesh in loaded.geometry.values()):
            raise ValueError("vertices are not x y z")
        if triangles is not None:
            found = sum(len(getattr(mesh, "faces", ())) for mesh in loaded.geometry.values())
            require(found == triangles, f"cut short or damaged: {found} of its {triangles} triangles can be read")
        if kind == ".obj" and _lacks_normals(loaded, content) and (fault := obj_fault(original)):
            raise ValueError(fault)
        _check_size(loaded)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # every format of trimesh has its own exceptions
        reason = (str(error).splitlines() or [""])[0]
        # a missing import is how trimesh says that it cannot even guess the text encoding
        message = reason[:200] if reason and not isinstance(error, ImportError) else "content not understood"
        message = (obj_fault(original) if kind == ".obj" else "") or message
        raise InputError(f"{path}: broken {kind} file ({message})") from None
    return loaded


def check_kind(content: bytes, kind: str) -> None:
    """Raise InputError for a file that is empty, or holds another kind of mesh than its extension says."""
    require(bool(content.strip()), "the file is empty")
    wide = kind == ".obj" and content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    require(not wide, "is text of 16 bits a letter (UTF-16), expected UTF-8; save it so")
    actual = next((ext for magic, ext in MAGIC.items() if content.startswith(magic)), kind)
    require(actual == kind, f"holds {actual} data, its extension says {kind}; rename it")


def _checked(content: bytes, kind: str, beside: _Beside) -> tuple[bytes, int | None]:
    """Check a mesh file; return the content that trimesh is to read, and how many triangles it must find, where the
    file says so."""
    check_kind(content, kind)
    try:
        match kind:
            case ".stl":
                return plain_stl(content)
            case ".glb":
                check_glb(content, beside.get)
                content = plain_glb(content)
            case ".obj":
                # Comments and names in an old encoding must not stop the geometry from being read.
                content = plain_obj(content.decode("utf-8", errors="replace").encode())
                content = _with_one_library(content, beside)
    except NotReadError:
        raise
    except InputError as error:
        raise InputError(f"broken {kind} file ({error})") from None
    return content, None


def _lacks_normals(loaded: trimesh.Scene, content: bytes) -> bool:
    """Return whether a mesh of an OBJ that has normals has none: trimesh drops them where one index is too large."""
    meshes = [mesh for mesh in loaded.geometry.values() if len(getattr(mesh, "faces", ()))]
    return b"\nvn " in content and any("vertex_normals" not in mesh._cache for mesh in meshes)


def _check_size(loaded: trimesh.Scene) -> None:
    """InputError where all instances together are too many triangles."""
    sizes = {name: len(getattr(mesh, "faces", ())) for name, mesh in loaded.geometry.items()}
    triangles = sum(sizes[loaded.graph[node][1]] for node in loaded.graph.nodes_geometry)
    require(triangles <= MAX_TRIANGLES, f"{triangles} triangles with all instances, expected {MAX_TRIANGLES} at most")


def check_vertices(vertices: np.ndarray, name: str) -> None:
    """Raise InputError unless all coordinates are finite and of a size that can be computed with."""
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    require(not bad, f"{bad} of {len(vertices)} vertices of {name} are NaN or infinite")
    largest = float(np.abs(vertices).max(initial=0.0))
    message = f"a coordinate of {name} is {largest:g}, expected {MAX_COORDINATE:g} at the most"
    require(largest <= MAX_COORDINATE, message)


def read_material_library(path: Path, notes: list[str]) -> dict[str, MaterialEntry]:
    """Read the material library of an OBJ; InputError for a texture that it names and that is not there.

    trimesh reads the library too, but silently drops such textures and rounds Kd to 8 bits.
    """
    entries: dict[str, MaterialEntry] = {}
    text = lenient_text(path)
    for name in _library_names(text, path.parent):
        if not (path.parent / name.replace("\\", "/")).exists():
            notes.append(f"material file {name} not found")
            continue
        try:
            library = file_inside(path.parent, name, "material file")
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        entries |= read_library(library, notes)
    _note_undefined(text, entries, notes)
    return entries


def _note_undefined(text: str, entries: dict[str, MaterialEntry], notes: list[str]) -> None:
    """Note the names of an OBJ's usemtl lines that no material file defines: such faces have no material."""
    lines = text.replace("\t", " ").replace("\r", "\n")
    used = re.findall(r"^ *usemtl +(.*?) *$", lines, re.MULTILINE | re.IGNORECASE)
    used = [_without_comment(name, entries) for name in used]
    undefined = [name for name in dict.fromkeys(used) if name and name not in entries]
    if undefined:
        notes.append(f"usemtl names what no material file defines: {listed(undefined)}")


def _without_comment(name: str, known: Collection[str]) -> str:
    """Return a name without the comment behind it, where that makes a known one of it: names may hold a #, too."""
    bare = name.partition(" #")[0].strip()
    return bare if name not in known and bare in known else name


def _library_names(text: str, folder: Path) -> list[str]:
    """Return the material files that an OBJ names: a line is one name with blanks in it, or several names."""
    lines = re.findall(r"^[ \t]*mtllib[ \t]+([^\r\n]*)", text.replace("\r", "\n"), re.MULTILINE | re.IGNORECASE)
    found: dict[str, None] = {}
    for line in lines:
        whole = line.strip()
        if " #" in whole and not (folder / whole).exists():
            whole = whole.partition(" #")[0].strip()
        if whole:
            names = whole.split()
            several = not (folder / whole).exists() and all(name.lower().endswith(".mtl") for name in names)
            found |= dict.fromkeys(names if several else [whole])
    return list(found)


def _with_one_library(content: bytes, beside: _Beside) -> bytes:
    """Return an OBJ that names one material file at most, of the names of all its materials.

    trimesh reads the first file alone, and drops all materials where one of its lines is unlike what it expects.
    """
    names = _library_names(content.decode("utf-8", errors="replace"), beside.folder)
    if not names:
        return content
    there = [name for name in names if (beside.folder / name.replace("\\", "/")).exists()]
    lines = [line.strip() for name in there for line in without_mark(beside.get(name)).splitlines()]
    beside.textured = any(line.lower().startswith(b"map_kd") for line in lines)
    made = [line for line in lines if line.lower().startswith(b"newmtl")]
    beside.made["all.mtl"] = b"\n".join(b"newmtl" + line[6:] for line in made)
    if b"\nusemtl" in content and re.search(rb"^usemtl.* #", content, re.MULTILINE):
        known = {" ".join(line[6:].decode("utf-8", errors="replace").split()) for line in made}

        def bare(name: re.Match[bytes]) -> bytes:
            return b"usemtl " + _without_comment(name[1].decode().strip(), known).encode()

        content = re.sub(rb"^usemtl +(.* #.*)", bare, content, flags=re.MULTILINE)
    return b"mtllib all.mtl\n" + re.sub(rb"^mtllib.*", b"", content, flags=re.MULTILINE)
