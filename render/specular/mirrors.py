"""Plane smooth faces of a scene and their images: the geometry of specular light. Plain numpy, float64.

Everything has the scene's axes, and the camera at the origin.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Interactions, Masks, UInts
from render.scene.rays import TOUCHING, shape_index
from render.scene.traced_scene import Float, TracedScene, UInt32, dr
from scenes.errors import listed, require
from scenes.geometry.shapes import axis_frame
from scenes.model import Surface

MAX_ORDER = 3  # mirrors in a row
MAX_PLANES = 64  # a smooth mesh of more planes is a curved surface
MAX_SEQUENCES = 1 << 18
MAX_SLAB_ERROR_M = 0.010
# A glint is a thin cone of rays: on an edge or in the apex of a corner cube, the share of them that comes back counts.
LOBE_RAYS, LOBE_RAD = 32, 5e-4
COATED = ("conductor", "plastic", "dielectric", "thindielectric")


class Mirrors(NamedTuple):
    """Plane smooth faces n . x = c, the camera at the origin, (n,) or (n, 3) each.

    `low` and `high` bound the face, and so do the `corners` (n, 4, 3) of a rectangle in its plane; `shape` is its
    mesh's registered index; `is_metal` and `is_solid` (thick glass) its material; what is not
    metal is glass or the coat of plastic.
    """

    normal: np.ndarray
    offset: np.ndarray
    low: np.ndarray
    high: np.ndarray
    corners: np.ndarray
    shape: np.ndarray
    is_metal: np.ndarray
    is_solid: np.ndarray


class SlabError(NamedTuple):
    """Bounds over the view on what a straight line through a glass solid does wrong [m]; `flat`: it is a slab."""

    name: str
    thickness_m: float
    shift_m: float
    path_m: float
    flat: bool


def find_mirrors(world: TracedScene) -> tuple[Mirrors, list[str]]:
    """Return all plane smooth faces of a scene, and notes that name the smooth surfaces that are curved."""
    rows, notes = [], []
    curved: dict[str, None] = {}
    for shape, group in zip(world.shape_ids, world.groups, strict=True):
        kind = group[0].material.kind
        if kind not in COATED:
            continue
        planes: list[tuple] = []
        for surface in group:
            found = planes_of(surface, world.scene.camera.origin)
            if found is None:
                curved.setdefault(surface.name, None)
            planes += found or ()
        rows += [(*plane, shape, kind == "conductor", kind == "dielectric") for plane in _merged(planes)]
    if curved:
        notes.append(
            f"specular light: curved smooth surfaces ({listed(curved)}): glints and what they light are left out"
        )
    kinds = {surface.material.kind for surface in world.scene.surfaces}
    if kinds & {"dielectric", "thindielectric"}:
        notes.append(
            "glass: its own return and what it reflects of directly lit surfaces is rendered, no indirect light"
        )
    if "plastic" in kinds:
        notes.append("smooth plastic: what its coat lights is rendered, not what that lights in turn")
    if any(row[6] for row in rows):
        notes.append("mirrors: light by way of them that meets two or more other surfaces first is left out")
    of_none = [np.empty((0, *shape)) for shape in ((3,), (), (3,), (3,), (4, 3), (), (), ())]
    columns: list = list(zip(*rows, strict=True)) if rows else of_none
    types = (float, float, float, float, float, np.int64, bool, bool)
    return Mirrors(*(np.array(c, dtype=t) for c, t in zip(columns, types, strict=True))), notes


def planes_of(surface: Surface, origin: np.ndarray) -> list[tuple] | None:
    """Return planes (normal, offset, low, high, corners) of a mesh relative to `origin`; None for a curved one.

    Triangles without area do not count.
    """
    corners = (surface.vertices - origin)[surface.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    kept = area > 1e-12 * max(area.max(), 1e-300)
    if surface.normals is not None:
        shading = surface.normals[surface.faces]
        shading = shading / np.maximum(np.linalg.norm(shading, axis=-1, keepdims=True), 1e-300)
        flat = np.abs(np.einsum("fcj,fj->fc", shading, normal)) > (1 - 1e-5) * area[:, None]
        if not flat[kept].all():
            return None
    order = np.argsort(-area[kept], kind="stable")
    corners, normal = corners[kept][order], (normal[kept] / area[kept, None])[order]
    # a curved mesh shows in its largest faces already: no need to look for planes among a million
    if len(corners) > 256 and _cluster(corners[:256], normal[:256]) is None:
        return None
    return _cluster(corners, normal)


def _cluster(corners: np.ndarray, normal: np.ndarray) -> list[tuple] | None:
    planes: list[tuple] = []
    while len(corners):
        if len(planes) == MAX_PLANES:
            return None
        n, c = normal[0], float(normal[0] @ corners[0, 0])
        size = np.abs(corners).max()
        close = np.abs(corners @ n - c).max(axis=1) < 2e-6 * size
        same = close & (np.abs(normal @ n) > 1 - 1e-6)
        same[0] = True
        points = corners[same].reshape(-1, 3)
        planes.append((n, c, points.min(axis=0), points.max(axis=0), _rectangle(n, c, points)))
        corners, normal = corners[~same], normal[~same]
    return planes


def _merged(planes: list[tuple]) -> list[tuple]:
    """Return planes of which equal ones are one: two surfaces of one material in one plane give one glint."""
    kept: list[tuple] = []
    normals, offsets, sizes = np.empty((len(planes), 3)), np.empty(len(planes)), np.empty(len(planes))
    for plane in planes:
        count = len(kept)
        normal, offset, low, high, corners = plane
        cosine = normals[:count] @ normal
        off = np.abs(np.sign(cosine) * offset - offsets[:count])
        equal = np.flatnonzero((np.abs(cosine) > 1 - 1e-9) & (off < 2e-6 * sizes[:count]))
        place = equal[0] if len(equal) else count
        if len(equal):
            n, c, a, b, before = kept[place]
            both = _rectangle(n, c, np.concatenate((before, corners)))
            kept[place] = (n, c, np.minimum(a, low), np.maximum(b, high), both)
        else:
            kept.append(plane)
            normals[place], offsets[place] = normal, offset
        sizes[place] = max(np.abs(kept[place][2]).max(), np.abs(kept[place][3]).max())
    return kept


def _rectangle(normal: np.ndarray, offset: float, points: np.ndarray) -> np.ndarray:
    """Return the corners (4, 3) of a rectangle in the plane normal . x = offset around points on it."""
    across = axis_frame(normal)[:, :2]
    low, high = (points @ across).min(axis=0), (points @ across).max(axis=0)
    return offset * normal + np.array([(a, b) for a in (low[0], high[0]) for b in (low[1], high[1])]) @ across.T


def mirrors_in_row(world: TracedScene, si: Interactions, before: UInts | None, active: Masks) -> Array:
    """Return how many mirrors of smooth metal a path from the camera has met up to this surface, `before` it (None: it
    is the first one) and with it; more than MAX_ORDER from the first other surface on."""
    if not world.has_mirrors:
        return UInt32(MAX_ORDER + 1) if before is None else before
    met = active & (dr.gather(Float, world.mirrors, shape_index(si), active) > 0)
    return dr.select(met, (0 if before is None else before) + 1, MAX_ORDER + 1)


def without_mirrored_light(light: Floats, mirrors: UInts) -> Array:
    """Leave out laser light of a surface that a path met after so many `mirrors_in_row`, which `render.specular`
    traces."""
    return dr.select(mirrors <= MAX_ORDER, 0, light)


def lit_mirrors(world: TracedScene, mirrors: Mirrors) -> np.ndarray:
    """Return which planes the laser shines on, (n,) bool: a lamp on a wall lights the room, and not the wall."""
    camera = world.scene.camera
    laser = world.scene.laser.position(camera) - camera.origin
    return np.abs(mirrors.normal @ laser - mirrors.offset) > TOUCHING * np.abs(laser).max()


def glint_sequences(mirrors: Mirrors, notes: list[str]) -> list[np.ndarray]:
    """Return mirrors in a row, (m, k) plane indices for k = 1, 2, 3. Solid glass, which refracts, stands alone."""
    found = [np.arange(len(mirrors.offset))[:, None]] if len(mirrors.offset) else []
    planes, most = np.flatnonzero(~mirrors.is_solid), MAX_SEQUENCES
    for order in range(2, MAX_ORDER + 1):
        number = len(planes) * (len(planes) - 1) ** (order - 1)
        if number > most:
            notes.append(f"glints by {order} or more mirrors left out: {number} ways among {len(planes)} planes")
            break
        most -= number
        if number:
            rows = planes[np.indices((len(planes),) * order).reshape(order, -1).T]
            found.append(rows[(rows[:, 1:] != rows[:, :-1]).all(axis=1)])
    return found


def image_of(mirrors: Mirrors, sequence: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return S_1 ... S_k x of a point for each row of (m, k) planes, (m, 3)."""
    image = np.tile(point, (len(sequence), 1))
    for plane in sequence.T[::-1]:
        normal = mirrors.normal[plane]
        image -= 2 * ((normal * image).sum(axis=1) - mirrors.offset[plane])[:, None] * normal
    return image


def specular_points(
    mirrors: Mirrors, sequence: np.ndarray, image: np.ndarray, slack_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the way from the camera to an image last leaves a mirror, (m, 3), and whether it may exist at all,
    (m,)."""
    total = np.linalg.norm(image, axis=1)
    direction = image / np.maximum(total, 1e-300)[:, None]
    position, left = np.zeros_like(image), total
    slack = slack_rad * total
    possible = total > 0
    for plane in sequence.T:
        normal = mirrors.normal[plane]
        cosine = (normal * direction).sum(axis=1)
        possible &= np.abs(cosine) > 1e-9
        gap = mirrors.offset[plane] - (normal * position).sum(axis=1)
        step = gap / np.where(np.abs(cosine) > 1e-9, cosine, 1)
        position = position + step[:, None] * direction
        left = left - step
        possible &= (step > -slack) & (left > -slack)
        inside = (position > mirrors.low[plane] - slack[:, None]) & (position < mirrors.high[plane] + slack[:, None])
        possible &= inside.all(axis=1)
        direction = direction - 2 * cosine[:, None] * normal
    return position, possible


def check_slabs(world: TracedScene) -> list[str]:
    """Return notes on light that a straight line through solid glass puts in a wrong place.

    Raises InputError where that is more than 10 mm of path beside a displaced laser.
    """
    errors = slab_error_m(world)
    lenses, slabs = [e.name for e in errors if not e.flat], [e for e in errors if e.flat]
    notes = []
    what = "indirect light crosses it" if world.refracts else "crossed"
    if lenses:
        notes.append(f"glass {_gathered(lenses)}: bends light as a lens does, {what} here in a straight line")
    if not slabs:
        return notes
    worst = max(slabs, key=lambda error: error.path_m)
    off = f"{1e3 * max(e.shift_m for e in slabs):.1f} mm beside it, {1e3 * worst.path_m:.1f} mm of path"
    allowed = world.scene.laser.is_colocated or worst.path_m <= MAX_SLAB_ERROR_M
    limit = f"the limit with a displaced laser is {1e3 * MAX_SLAB_ERROR_M:.0f} mm"
    require(allowed, f"glass {worst.name}: a straight line through it is up to {off} off the refracted one; {limit}")
    names = _gathered([error.name for error in slabs])
    return [*notes, f"glass {names}: {what} in a straight line, up to {off} off the refracted one"]


def _gathered(names: list[str]) -> str:
    """Name one solid, or give the number and the first names of several."""
    return names[0] if len(names) == 1 else f"({len(names)} solids: {listed(names)})"


def slab_error_m(world: TracedScene) -> list[SlabError]:
    """Return bounds over the view on the error of a straight line through each solid of glass that the camera faces.

    At incidence a (b inside, sin a = n sin b) a slab of thickness t shifts a ray sideways by
    t sin a (1 - cos a / sqrt(n^2 - sin^2 a)), and a straight line is longer in path by at most
    n t (1/cos a - 1/cos b); the camera's leg and the laser's add up. a is the largest that the view and the solid
    allow, on the laser's leg larger by the parallax of the baseline at the slab.
    """
    camera = world.scene.camera
    baseline = np.linalg.norm(world.scene.laser.baseline_m)
    rays = camera.rays(np.array([0, 0, 1, 1]) * camera.width, np.array([0, 1, 0, 1]) * camera.height)
    errors = []
    for surface in world.scene.surfaces:
        if surface.material.kind != "dielectric":
            continue
        points = surface.vertices - camera.origin
        if (points @ camera.rotation[:, 2]).max() <= 0:
            continue
        planes = planes_of(surface, camera.origin)
        if planes is None:
            errors.append(SlabError(surface.name, math.nan, math.inf, math.inf, False))
            continue
        normal = min((plane[0] for plane in planes), key=lambda n: np.ptp(points @ n))
        height = points @ normal
        thickness, extent = float(np.ptp(height)), float(np.linalg.norm(np.ptp(points, axis=0)))
        cosine = max(
            (np.abs(height) / np.maximum(np.linalg.norm(points, axis=1), 1e-300)).min(), np.abs(rays @ normal).min()
        )
        angle = math.acos(min(cosine, 1.0))
        before = np.abs(height).min() if height.min() * height.max() > 0 else 0.0
        shift = path = 0.0
        for a in (angle, min(angle + math.atan2(baseline, before), math.pi / 2)):
            inside = math.sqrt(1 - (math.sin(a) / surface.material.ior) ** 2)
            straight = min(thickness / max(math.cos(a), 1e-12), extent)
            shift = max(shift, thickness * math.sin(a) * (1 - math.cos(a) / (surface.material.ior * inside)))
            path += max(surface.material.ior * (straight - thickness / inside), 0.0)
        errors.append(SlabError(surface.name, thickness, shift, path, True))
    return errors


def lobe_points(image: np.ndarray) -> np.ndarray:
    """Spread points over a small disk around each image as seen from the camera, (m, LOBE_RAYS, 3): a sunflower's
    spiral."""
    number = np.arange(LOBE_RAYS)
    radius = LOBE_RAD * np.sqrt((number + 0.5) / LOBE_RAYS)
    angle = number * math.pi * (3 - math.sqrt(5)) + 0.5
    axis = np.eye(3)[np.abs(image).argmin(axis=1)]
    first = np.cross(image, axis)
    first *= (np.linalg.norm(image, axis=1) / np.linalg.norm(first, axis=1))[:, None]
    second = np.cross(image, first) / np.linalg.norm(image, axis=1, keepdims=True)
    around = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return image[:, None] + radius[:, None] * around
