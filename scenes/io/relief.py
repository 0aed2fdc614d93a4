"""RGB-D pairs as relief meshes: a photograph's colours as albedo on the surface that its depth image describes.

The mesh has one vertex a pixel, on the ray through the pixel's centre. Where depth jumps it is cut: each of the
pixels around the cut keeps its own depth up to its border, so nothing is stretched and, from the camera, nothing gapes.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.errors import InputError, require
from scenes.geometry.shapes import grid_faces
from scenes.io.inputs import read_text
from scenes.io.textures import exr_channels, load_texture, opened_image
from scenes.model import Camera, Material, Scene, Surface, Texture

# Middlebury 2006: focal length [px] of the full-size images, baseline [m]; the files are half-size, and hold
# disparities of the full size.
MIDDLEBURY_FOCAL_PX, MIDDLEBURY_BASELINE_M, MIDDLEBURY_SHRUNK = 3740.0, 0.160, 2
LUMA = (0.2989, 0.5870, 0.1140)  # of the published simulations
# Neighbours whose depths differ by more than a slope of 85 degrees, and by more than quantisation explains, are apart.
CUT_SLOPE, CUT_LEVELS = math.tan(math.radians(85)), 2.5
HAIR_PX = 2e-3
# Vertices stand a little off the pixel centres: a ray through the very vertex of a mesh can miss all of its faces.
OFF_CENTRE_PX = 0.01
SPANS_PX = (16, 8, 4, 2, 1)  # dequantising: distances over which straight lines are sought, and how often
PASSES = 12
MAX_LEVEL = 0.485
MIDDLEBURY_FILES = ("view1.png", "disp1.png", "dmin.txt")
DATA_VARIABLE = "SCENE2SPAD_DATA"
DEPTH_EXTENSIONS = (".png", ".exr")
MAX_DEPTH_M = 1e4
FOCAL_PX = (1e-3, 1e9)  # outside, the angle of any image is beyond the limits of a camera
SCALE_M = (1e-12, 1e4)  # metres of one level of a depth image


@dataclass(frozen=True)
class RgbdFiles:
    """A user's pair: depth along the camera's axis in `depth`, `scale_m` metres a unit, focal length in pixels.

    `cosine`: see `relief`.
    """

    image: Path
    depth: Path
    focal_px: float
    scale_m: float | None = None
    cosine: bool = False

    def __post_init__(self) -> None:
        low, high = FOCAL_PX
        require(self.focal_px > 0, f"focal length {self.focal_px:g} px is not positive")
        require(low <= self.focal_px <= high, f"focal length {self.focal_px:g} px is outside {low:g} to {high:g}")
        kind = Path(self.depth).suffix.lower()
        require(kind in DEPTH_EXTENSIONS, f"{self.depth}: depth image {kind or '(none)'}, expected .png or .exr")
        known = self.scale_m is not None or kind == ".exr"
        require(known, f"{self.depth}: the unit of an integer depth image is not known; give its scale, metres a level")
        low, high = SCALE_M
        if self.scale_m is not None:
            require(self.scale_m > 0, f"depth scale {self.scale_m} m a level is not positive")
            require(
                low <= self.scale_m <= high, f"depth scale {self.scale_m:g} m a level is outside {low:g} to {high:g}"
            )


def relief(
    name: str,
    depth_m: np.ndarray,
    albedo: Texture,
    focal_px: float,
    *,
    half_level_m: np.ndarray | float = 0.0,
    cosine: bool = False,
    notes: tuple[str, ...] = (),
) -> Scene:
    """Return the relief of a depth image (h, w) along the camera's axis [m], all finite; the camera is its own.

    focal_px belongs to the depth image's pixels; half_level_m is what quantisation may have moved a depth by.
    cosine False: a photograph's colours hold its own shading, so shading normals face the camera and the laser's light
    is not shaded a second time: returns are albedo I / (pi d^2). True: colours are reflectances, and the cosine of the
    mesh's own surface is applied, albedo cos I / (pi d^2). Footprints follow the mesh in both.
    """
    rows, columns = depth_m.shape
    padded = np.pad(depth_m, 1, mode="edge").astype(np.float64)
    x = (np.arange(-1, columns + 1) + 0.5 + OFF_CENTRE_PX - columns / 2) / focal_px
    y = -(np.arange(-1, rows + 1) + 0.5 + OFF_CENTRE_PX - rows / 2) / focal_px
    u = (np.arange(-1, columns + 1) + 0.5 + OFF_CENTRE_PX) / columns
    v = 1 - (np.arange(-1, rows + 1) + 0.5 + OFF_CENTRE_PX) / rows
    step = np.pad(np.broadcast_to(half_level_m, depth_m.shape), 1, mode="edge")
    apart = _cuts(padded, focal_px, 2 * step)
    ray = np.stack((*np.broadcast_arrays(x, y[:, None]), -np.ones_like(padded)), axis=-1)
    grid = (ray * padded[..., None]).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(u, v[:, None]), axis=-1).reshape(-1, 2)
    # `grid_faces` counts rows upwards, an image's run downwards
    faces = grid_faces(*padded.shape)[:, ::-1].reshape(-1, 2, 3)[~apart.ravel()].reshape(-1, 3)
    flaps, flap_uv, flap_faces = _flaps(padded, apart, x, y, u, v)
    vertices = np.concatenate((grid, flaps))
    faces = np.concatenate((faces, flap_faces + len(grid)))
    normals = None if cosine else -vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    # half of a border pixel lies outside its texel's centre, where a repeating image shows its other border
    material = Material(albedo=replace(albedo, clamps=True), name=albedo.name)
    mesh = Surface(vertices, faces, material, uv=np.concatenate((uv, flap_uv)), normals=normals, name="relief")
    fov = math.degrees(2 * math.atan(columns / 2 / focal_px))
    camera = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov, width=columns, height=rows)
    message = f"relief: {int(apart.sum())} of {apart.size} cells cut at depth edges"
    shading = f"shading: cosine {'applied' if cosine else 'not applied, the photograph holds its own'}"
    return Scene(name, (mesh,), camera, notes=(*notes, message, shading))


def _cuts(depth: np.ndarray, focal_px: float, level: np.ndarray) -> np.ndarray:
    """Cells of the vertex grid (h - 1, w - 1) with corners that are apart."""
    corners = np.stack((depth[:-1, :-1], depth[:-1, 1:], depth[1:, :-1], depth[1:, 1:]))
    near, far = corners.min(axis=0), corners.max(axis=0)
    allowed = np.maximum(CUT_SLOPE * near / focal_px, CUT_LEVELS * level[:-1, :-1])
    return far - near > allowed


def _flaps(
    depth: np.ndarray, apart: np.ndarray, x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Four quarter squares a cut cell, each as deep as the pixel at its corner: vertices, uv, faces."""
    row, column = np.nonzero(apart)
    if len(row) == 0:
        return np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 3), np.int64)
    points, coordinates = [], []
    for down in (0, 1):
        for right in (0, 1):
            z = depth[row + down, column + right]
            i, j = row + down, column + right
            for a, b in ((0, 0), (0, 1), (1, 1), (1, 0)):
                # from the corner (0) to the middle of the cell (1), along rows and columns
                to_i, to_j = i + (a - 2 * a * down) * 0.5, j + (b - 2 * b * right) * 0.5
                # a hair over both ends, so that a ray through a vertex does not slip between patches
                to_i, to_j = (
                    to_i + HAIR_PX * (1 - 2 * down) * (2 * a - 1),
                    to_j + HAIR_PX * (1 - 2 * right) * (2 * b - 1),
                )
                px, py = x[0] + to_j * (x[1] - x[0]), y[0] + to_i * (y[1] - y[0])
                points.append(np.column_stack((px * z, py * z, -z)))
                coordinates.append(np.column_stack((u[0] + to_j * (u[1] - u[0]), v[0] + to_i * (v[1] - v[0]))))
    vertices, uv = (np.stack(parts, axis=1).reshape(-1, parts[0].shape[1]) for parts in (points, coordinates))
    first = 4 * np.arange(4 * len(row))[:, None]
    # of the four quarters, those on one diagonal run the other way round
    turned = np.tile((False, True, True, False), len(row))[:, None]
    quads = np.where(turned, first + (3, 2, 1, 0), first + (0, 1, 2, 3))[:, ::-1]
    faces = np.concatenate((quads[:, (0, 1, 2)], quads[:, (0, 2, 3)]))
    return vertices, uv, faces.astype(np.int64)


# --- Quantised images ------------------------------------------------------------------------------------------------


def filled(levels: np.ndarray, known: np.ndarray, *, near_is_high: bool) -> np.ndarray:
    """Return unknown pixels from the known ones left and right of them: the farther of the two, since what a second
    camera did not see lies behind; rows without a known pixel from the nearest row. InputError if nothing is known."""
    require(bool(known.any()), "depth image holds no known pixel")
    order = levels.astype(np.float64) * (1 if near_is_high else -1)
    rows = np.flatnonzero(known.any(axis=1))
    result = np.empty_like(order)
    columns = np.arange(levels.shape[1])
    for i in rows:
        at = columns[known[i]]
        left = at[np.clip(np.searchsorted(at, columns, "right") - 1, 0, len(at) - 1)]
        right = at[np.clip(np.searchsorted(at, columns, "left"), 0, len(at) - 1)]
        result[i] = np.minimum(order[i, left], order[i, right])
    nearest = rows[np.abs(np.arange(len(levels))[:, None] - rows).argmin(axis=1)]
    return result[nearest] * (1 if near_is_high else -1)


def dequantised(levels: np.ndarray) -> np.ndarray:
    """Return whole levels made smooth: straight lines through the steps, never half a level from the given value.

    Each pass replaces a pixel by the mean of what lies opposite each other, `span` pixels to both sides along rows or
    columns, where both are within the span's slope of the pixel (no edge between), and clips to MAX_LEVEL from the
    given value. Straight slopes are left as they are, steps of one level become slopes, edges stay.
    """
    low, high = levels - MAX_LEVEL, levels + MAX_LEVEL
    smooth = levels.astype(np.float64)
    for span in SPANS_PX:
        if span >= min(levels.shape) // 2:
            continue
        for _ in range(PASSES):
            total, count = smooth.copy(), np.ones_like(smooth)
            for axis in (0, 1):
                middle, before, after = _opposite(smooth, span, axis)
                mean = 0.5 * (before + after)
                # opposite neighbours far from each other are fine on a slope, but not one of them alone
                near = (np.abs(mean - middle) < 1.0) & (np.abs(before - after) < 2.0 + 0.5 * span)
                inner = [slice(None), slice(None)]
                inner[axis] = slice(span, -span)
                total[tuple(inner)] += np.where(near, 2 * mean, 0)
                count[tuple(inner)] += np.where(near, 2, 0)
            smooth = np.clip(total / count, low, high)
    return smooth


def _opposite(image: np.ndarray, span: int, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inner pixels and their neighbours `span` before and after, along an axis."""
    turned = np.moveaxis(image, axis, 0)
    parts = turned[span:-span], turned[: -2 * span], turned[2 * span :]
    here, before, after = (np.moveaxis(part, 0, axis) for part in parts)
    return here, before, after


# --- Files -----------------------------------------------------------------------------------------------------------


def data_folder(given: Path | None = None) -> Path:
    """Return where data that come without the project lie: the folder given, $SCENE2SPAD_DATA, or shared/data beside
    the project."""
    return given or Path(os.environ.get(DATA_VARIABLE) or Path(__file__).parents[3] / "shared" / "data")


def middlebury_folder(name: str, data: Path | None = None) -> Path:
    """Return where the scenes of Middlebury 2006 lie: `middlebury` in the data folder."""
    folder = data_folder(data) / "middlebury" / name
    require(
        folder.is_dir(), f"middlebury/{name}: folder {folder} not found; set {DATA_VARIABLE} to what holds middlebury/"
    )
    return folder


def middlebury_names(data: Path | None = None) -> list[str]:
    """Return the Middlebury scenes that are there, sorted."""
    parent = middlebury_folder("", data)
    return sorted(path.name for path in parent.iterdir() if (path / "disp1.png").is_file())


def middlebury(folder: Path, *, cosine: bool = False, width: int | None = None, height: int | None = None) -> Scene:
    """Return a scene of Middlebury 2006 at half size: view1.png, disp1.png (0 = unknown) and dmin.txt in one folder.

    Depth along the axis = 3740 px 0.16 m / (disp1 + dmin), focal length 1870 px.
    """
    folder = Path(folder)
    disparity, least = read_disparity(folder)
    known = disparity > 0
    levels = filled(disparity, known, near_is_high=True)
    full = dequantised(levels) + least
    require(bool(full.min() > 0), f"{folder}: disparity + dmin is {full.min():g}, expected more than 0")
    depth = MIDDLEBURY_FOCAL_PX * MIDDLEBURY_BASELINE_M / full
    scene = relief(
        f"middlebury/{folder.name}",
        depth,
        _albedo(folder / "view1.png", depth.shape),
        MIDDLEBURY_FOCAL_PX / MIDDLEBURY_SHRUNK,
        half_level_m=0.5 * depth / full,
        cosine=cosine,
        notes=(f"holes: {1 - known.mean():.2%} of the disparities filled from behind",),
    )
    return replace(scene, camera=scene.camera.resized(width, height))


def read_disparity(folder: Path) -> tuple[np.ndarray, float]:
    """Return disp1.png (0 = unknown) and the number of dmin.txt, to be added to it, of a Middlebury scene.

    Raises InputError naming the file that is missing, view1.png too, or broken.
    """
    for file in MIDDLEBURY_FILES:
        require((folder / file).is_file(), f"{folder / file}: file not found, expected in a Middlebury scene")
    try:
        least = float(read_text(folder / "dmin.txt").split()[0])
    except (ValueError, IndexError):
        raise InputError(f"{folder / 'dmin.txt'}: holds no number") from None
    return read_levels(folder / "disp1.png"), least


def read_luma(folder: Path, shape: tuple[int, int]) -> np.ndarray:
    """Return the luma of view1.png (h, w), 0 to 1, of a Middlebury scene whose disparities are of that shape.

    Raises InputError naming the file for another size, and one that cannot be read.
    """
    with opened_image(folder / "view1.png") as image:
        same = (image.height, image.width) == shape
        require(same, f"{image.width} x {image.height} pixels, disp1.png has {shape[1]} x {shape[0]}")
        return np.asarray(image.convert("RGB"), np.float64) @ LUMA / 255


def rgbd(files: RgbdFiles, *, width: int | None = None, height: int | None = None) -> Scene:
    """Return a user's RGB-D pair; 0, NaN and infinite depths are holes."""
    path = Path(files.depth)
    integer = path.suffix.lower() == ".png"
    raw = read_levels(path) if integer else _exr_depth(path)
    known = np.isfinite(raw) & (raw > 0)
    require(bool(known.any()), f"{path}: holds no known depth (all 0, NaN or infinite)")
    values = filled(np.where(known, raw, 0), known, near_is_high=False)
    scale = 1.0 if files.scale_m is None else files.scale_m
    depth = scale * (dequantised(values) if integer else values)
    fits = depth.min() > 0 and depth.max() <= MAX_DEPTH_M
    require(
        fits, f"{path}: depths of {depth.min():g} to {depth.max():g} m, expected 0 to {MAX_DEPTH_M:g}; check the scale"
    )
    notes = [f"holes: {1 - known.mean():.2%} of the depths filled from behind"]
    if files.scale_m is None:
        notes.append("depth taken in metres, as .exr has no scale of its own")
    if np.median(depth) > 100:
        notes.append(f"median depth {np.median(depth):.4g} m: is the scale right?")
    half = 0.5 * scale if integer else 0.0
    texture = _albedo(Path(files.image), depth.shape)
    scene = relief(
        Path(files.image).stem,
        depth,
        texture,
        files.focal_px,
        half_level_m=half,
        cosine=files.cosine,
        notes=tuple(notes),
    )
    return replace(scene, camera=scene.camera.resized(width, height))


def _albedo(path: Path, shape: tuple[int, int]) -> Texture:
    """Read the photograph's linear luminance; its proportions must be the depth image's."""
    texture = load_texture(path)
    tall, wide = texture.image.shape
    same = abs(wide * shape[0] - tall * shape[1]) <= max(shape)
    require(same, f"{path}: {wide} x {tall} pixels, the depth image has {shape[1]} x {shape[0]}: other proportions")
    return texture


def read_levels(path: Path) -> np.ndarray:
    """Return a single-channel 8- or 16-bit image as whole numbers (h, w) float64, whatever its mode."""
    with opened_image(path, "depth image") as image:
        deep = len(image.getbands()) > 1 and any("16" in str(tile.args) for tile in getattr(image, "tile", ()))
        require(not deep, f"16 bits in {len(image.getbands())} channels, of which 8 would be read; save one channel")
        values = np.asarray(image.convert("RGB") if image.mode == "P" else image)
    if values.ndim == 3 and (values[..., :1] == values[..., :3]).all():
        values = values[..., 0]
    integer = values.ndim == 2 and np.issubdtype(values.dtype, np.integer)
    require(integer, f"{path}: {values.shape} {values.dtype} pixels, expected one channel of whole numbers")
    return values.astype(np.float64)


def _exr_depth(path: Path) -> np.ndarray:
    """Channel Z, or Y, or the only one."""
    pixels = exr_channels(path, "depth image")
    name = next((n for n in ("Z", "depth", "Y") if n in pixels), next(iter(pixels)) if len(pixels) == 1 else None)
    if name is None:
        raise InputError(f"{path}: channels {', '.join(sorted(pixels))}, expected Z or Y")
    return pixels[name]
