"""Small Mitsuba scene files for tests, what becomes of them, and rays into it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenes import InputError, Scene, Surface, Texture
from scenes.io.mitsuba.scene_file import load_mitsuba_xml

SENSOR = (
    '<sensor type="perspective"><float name="fov" value="60"/>'
    '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>'
)
RECTANGLE = '<shape type="rectangle"/>'
GREY = '<rgb name="reflectance" value="0.2 0.4 0.6"/>'
LUMINANCE = 0.2126 * 0.2 + 0.7152 * 0.4 + 0.0722 * 0.6
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
OBJ_NORMALS = "vn 0 0 1\nvn 0.6 0 0.8\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "property float nx\nproperty float ny\nproperty float nz\nproperty float u\nproperty float v\n"
    "element face 2\nproperty list uchar int vertex_index\nend_header\n"
    "0 0 0 0 0 1 0 0\n1 0 0 0 0 1 1 0\n1 1 0.5 0.6 0 0.8 1 1\n0 1 0 0 0 1 0 1\n3 0 1 2\n3 0 2 3\n"
)


def write(folder: Path, body: str, *, version: str = "3.0.0", sensor: str = SENSOR, name: str = "a.xml") -> Path:
    path = folder / name
    path.write_text(f'<scene version="{version}">\n{body}\n{sensor}\n</scene>\n')
    return path


def load(folder: Path, body: str, **options: str) -> Scene:
    return load_mitsuba_xml(write(folder, body, **options))


def material(folder: Path, bsdf: str, **options: str) -> object:
    return load(folder, f'<shape type="rectangle">{bsdf}</shape>', **options).surfaces[0].material


def refusal(folder: Path, body: str, **options: str) -> str:
    """The message a scene is refused with: one line that begins with the file."""
    path = write(folder, body, **options)
    with pytest.raises(InputError) as error:
        load_mitsuba_xml(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


def image(folder: Path, name: str, values: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(np.asarray(values, np.uint8)).save(folder / name)


def first_hit(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """Point, shading normal, face normal and uv of the nearest hit, by solving every triangle."""
    origin, direction = np.asarray(origin, float), np.asarray(direction, float)
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    system = np.stack((b - a, c - a, np.broadcast_to(-direction, a.shape)), axis=-1)
    solvable = abs(np.linalg.det(system)) > 1e-14
    solution = np.full_like(a, np.nan)
    solution[solvable] = np.linalg.solve(system[solvable], (origin - a)[solvable][..., None])[..., 0]
    u, v, t = solution.T
    t = np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6), t, np.inf)
    i = int(np.argmin(t))
    assert np.isfinite(t[i])
    weights = np.array([1 - u[i] - v[i], u[i], v[i]])
    face = np.cross(b[i] - a[i], c[i] - a[i])
    face /= np.linalg.norm(face)
    normal = face if surface.normals is None else weights @ surface.normals[surface.faces[i]]
    uv = np.zeros(2) if surface.uv is None else weights @ surface.uv[surface.faces[i]]
    return origin + t[i] * direction, normal / np.linalg.norm(normal), face, uv


def texel(texture: Texture, uv: np.ndarray) -> float:
    height, width = texture.image.shape
    return float(texture.image[int((1 - uv[1]) % 1 * height) % height, int(uv[0] % 1 * width) % width])


def meshes(folder: Path) -> None:
    (folder / "flat.obj").write_text(OBJ + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "quad.obj").write_text(OBJ + OBJ_NORMALS + "usemtl none\nmtllib ../none.mtl\nf 1/1/1 2/2/1 3/3/2 4/4/1\n")
    (folder / "bare.obj").write_bytes("# für alle\n".encode("latin-1") + (OBJ + "f 1 2 3\nf 1 3 4\n").encode())
    (folder / "mesh.ply").write_text(PLY)
