"""Procedural indoor views: a room of random shape, furnished along its walls, cluttered, and seen as a person would.

A room is seen by a few cameras, as in data sets of real rooms: views n V to n V + V - 1 of a split show room n.
Depths follow NYUv2's: 0.5 to 7 m, median 2 to 3.5 m. The room is closed: no ray leaves it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from scenes.geometry.shapes import Shape
from scenes.library.layout import Boxes, Floor, Place, in_each_other, set_down, to_shell
from scenes.library.things import clutter, fittings, furniture
from scenes.library.things.palette import LAMP_RADIANCE, WINDOW_RADIANCE, make_palette, pick
from scenes.library.things.parts import Palette, Piece, Random, box, joined, panel, sheet, with_normals
from scenes.library.things.patterns import on_one_sheet
from scenes.model import Camera, Scene, Surface

SPLITS = ("train", "val", "test")
FOV_DEG = (52.0, 66.0)
NEAREST_M, FARTHEST_M = 0.6, 6.9
MEDIAN_M = (1.9, 3.9)  # of one view, by upright boxes; drawn evenly
OFF_M = 0.5  # below it, at most
CANDIDATES, DRAWS, ATTEMPTS = 120, 6, 8  # views of a room at a time, as often as it takes, rooms
MIN_BUSY = 0.3  # of a view, by upright boxes: what stands before the walls
VIEWS_PER_ROOM = 6  # raw frames of NYUv2 show a place some eighty times
APART_M, APART_DEG = 0.5, 30.0  # any two cameras of a room, at least
HEAD_M = 0.28  # half the side of the square that a head takes
FLAT = ("window", "door", "picture", "clock", "radiator", "rug")  # an image should show more than these


@dataclass(frozen=True, eq=False)
class Room:
    """A furnished room and its cameras, whose image size is whatever."""

    surfaces: tuple[Surface, ...]
    cameras: tuple[Camera, ...]


def room_view(index: int, split: str = "train", *, seed: int = 0, width: int = 64, height: int = 64) -> Scene:
    """Return view `index` of a split: room `index // VIEWS_PER_ROOM`; equal arguments give equal scenes, byte for byte.

    Splits draw from streams of their own and share no room. The last rooms are kept: their other views cost nothing.
    """
    number, which = divmod(index, VIEWS_PER_ROOM)
    room = room_of(split, number, seed)
    camera = replace(room.cameras[which], width=width, height=height)
    notes = (f"procedural, {split} view {index} of seed {seed}: camera {which} of room {number}",)
    return Scene(f"rooms/{split}/{index}", room.surfaces, camera, notes=notes)


def room_name(index: int, split: str) -> str:
    """Return the room that a view shows."""
    return f"rooms/{split}/room {index // VIEWS_PER_ROOM}"


@lru_cache(maxsize=2)
def room_of(split: str, number: int, seed: int) -> Room:
    """Return a room of a split by its number; the same seed gives the same room. The last ones are kept in memory."""
    stream = np.random.SeedSequence(seed, spawn_key=(SPLITS.index(split), number))
    for attempt in stream.spawn(ATTEMPTS):
        room = _attempt(np.random.default_rng(attempt))
        if room is not None:
            return room
    name = f"rooms/{split}: room {number}"
    raise RuntimeError(f"{name}: none of {ATTEMPTS} has {VIEWS_PER_ROOM} views of {NEAREST_M} to {FARTHEST_M} m")


def _attempt(rng: Random) -> Room | None:
    """One random room, and the best of some views of it; None if too few are good."""
    palette = make_palette(rng)
    floor, ceiling = Floor(_outline(rng)), float(rng.uniform(2.3, 3.0))
    surfaces = _shell(palette, rng, floor, ceiling)
    furnish(palette, rng, floor, ceiling)
    cameras = _cameras(rng, floor, ceiling)
    if cameras is None:
        return None
    surfaces += [surface for place in floor.places for surface in place.surfaces]
    surfaces += one_of_each(palette)
    return Room(tuple(with_normals(on_one_sheet(surfaces), float(rng.uniform(0.2, 2.0)))), cameras)


def one_of_each(palette: Palette, y: float = -0.5) -> list[Surface]:
    """Return a millimetre of every kind of material under the floor, where no light comes.

    A renderer compiles its kernels for the kinds of material that are there: so all views of a set have the same.
    """
    kinds = ("ceiling paint", "floor", "satin 0", "gloss 0", "steel", "glass", "sky", "lamp cloth")
    emission = {"sky": WINDOW_RADIANCE, "lamp cloth": LAMP_RADIANCE}
    tiny = panel((0, y, 0), (5e-4, 0, 0), (0, 0, -5e-4))
    return [joined("under the floor", palette[kind], tiny, emission=emission.get(kind, 0.0)) for kind in kinds]


# --- The room --------------------------------------------------------------------------------------------------------


def _outline(rng: Random) -> np.ndarray:
    """Draw a plan view, corners in order: rectangle, L, recess, cut corner, slanted wall or apse."""
    w, d = rng.uniform((2.8, 3.2), (5.6, 7.0))
    cut_w, cut_d = rng.uniform(0.25, 0.45) * w, rng.uniform(0.25, 0.45) * d
    kind = rng.choice(("rectangle", "L", "breast", "bevel", "slant", "apse"), p=(0.34, 0.2, 0.16, 0.12, 0.1, 0.08))
    if kind == "rectangle":
        points = [(0, 0), (w, 0), (w, d), (0, d)]
    elif kind == "L":
        points = [(0, 0), (w - cut_w, 0), (w - cut_w, cut_d), (w, cut_d), (w, d), (0, d)]
    elif kind == "breast":
        a, out = rng.uniform(0.3, 0.5) * w, rng.uniform(0.25, 0.5)
        points = [(0, 0), (a, 0), (a, out), (a + cut_w, out), (a + cut_w, 0), (w, 0), (w, d), (0, d)]
    elif kind == "bevel":
        points = [(0, 0), (w - cut_w, 0), (w, cut_w), (w, d), (0, d)]
    elif kind == "slant":
        points = [(0, 0), (w, 0.2 * cut_d), (w - 0.3 * cut_w, d), (0, d)]
    else:
        turn = np.linspace(-np.pi / 2, np.pi / 2, 11)
        points = [(0, 0), *((w + 0.3 * d * math.cos(a), d / 2 + d / 2 * math.sin(a)) for a in turn), (0, d)]
    outline = np.array(points, float)
    if rng.random() < 0.5:
        outline = outline[::-1] * (-1, 1)
    quarter = int(rng.integers(4))
    for _ in range(quarter):
        outline = np.column_stack((-outline[:, 1], outline[:, 0]))
    return outline - (outline.min(axis=0) + outline.max(axis=0)) / 2


def _shell(palette: Palette, rng: Random, floor: Floor, ceiling: float) -> list[Surface]:
    """Floor, walls, ceiling, sometimes a slope of the roof, skirting boards, beams or a picture rail."""
    low, high = floor.outline.min(axis=0) - 0.05, floor.outline.max(axis=0) + 0.05
    middle, half = (low + high) / 2, (high - low) / 2
    a, b = floor.edges
    walls, boards = [], []
    for start, end in zip(a, b, strict=True):
        centre, along = (start + end) / 2, (end - start) / 2
        walls.append(panel((centre[0], ceiling / 2, centre[1]), (along[0], 0, along[1]), (0, ceiling / 2, 0)))
        if np.linalg.norm(along) > 0.1:
            boards.append((start, end))
    surfaces = [
        joined("floor", palette["floor"], panel((middle[0], 0, middle[1]), (half[0], 0, 0), (0, 0, -half[1]))),
        joined(
            "ceiling",
            palette["ceiling paint"],
            panel((middle[0], ceiling, middle[1]), (half[0], 0, 0), (0, 0, half[1])),
        ),
        joined("walls", palette["wall"], *walls),
    ]
    if rng.random() < 0.7:
        skirting = [_along(start, end, 0.0, rng.uniform(0.06, 0.12), 0.015) for start, end in boards]
        surfaces.append(joined("skirting", pick(palette, rng, "paint" if rng.random() < 0.7 else "wood"), *skirting))
    if rng.random() < 0.18:
        beams = [
            box((low[0], ceiling - 0.16, z), (high[0], ceiling, z + 0.14))
            for z in np.arange(low[1] + 0.4, high[1], 0.9)
        ]
        surfaces.append(joined("beams", palette["wood 0"], *beams))
    elif rng.random() < 0.2:
        knee, run = rng.uniform(1.0, 1.5), rng.uniform(0.8, 1.3)
        # nothing stands or looks from under the slope
        floor.places.append(_lumber(np.array((low, (low[0] + 0.6 * run, high[1]))), ceiling))
        points = np.array(
            (
                ((low[0], knee, high[1]), (low[0], knee, low[1])),
                ((low[0] + run, ceiling, high[1]), (low[0] + run, ceiling, low[1])),
            )
        )
        surfaces.append(joined("roof", palette["ceiling paint"], sheet(points)))
    return surfaces


def _lumber(corners: np.ndarray, ceiling: float) -> Place:
    """Return a box that is not there but keeps things out."""
    (x0, z0), (x1, z1) = corners
    plan = np.array(((x0, z0), (x1, z0), (x1, z1), (x0, z1)))
    return Place(Piece(()), (0.0, 0.0, 0.0), 0.0, plan, 0.0, ceiling)


def _along(start: np.ndarray, end: np.ndarray, y: float, tall: float, thick: float) -> Shape:
    """Build a board along a wall from start to end (x, z), on the inside."""
    along = (end - start) / np.linalg.norm(end - start)
    inward = thick * np.array((-along[1], along[0]))
    line = np.array((start, start + inward, start + inward, start))
    lift = np.array((y + tall, y + tall, y, y))

    def ring(shift: np.ndarray) -> np.ndarray:
        return np.column_stack((line[:, 0] + shift[0], lift, line[:, 1] + shift[1]))

    return sheet(np.stack((ring(np.zeros(2)), ring(end - start)), axis=1)[::-1])


# --- What stands in it -----------------------------------------------------------------------------------------------


def furnish(palette: Palette, rng: Random, floor: Floor, ceiling: float) -> None:
    """Place windows and a door, then large things along the walls, then the middle, then what is small."""
    for kind, count in (("window", int(rng.integers(1, 3))), ("door", int(rng.random() < 0.7))):
        for _ in range(count):
            make = fittings.wall_window if kind == "window" else fittings.door
            floor.try_at_wall(make(palette, rng), rng, 8)
    if rng.random() < 0.5:
        floor.try_free(furniture.rug(palette, rng), rng, 6, turn_deg=float(rng.choice((0, 90)) + rng.normal(0, 4)))
        floor.places[-1:] = [replace(place, high=0.0) for place in floor.places[-1:]] if floor.places else []
    for kind in rng.permutation(list(furniture.AT_WALL))[: int(rng.integers(5, 10))]:
        floor.try_at_wall(furniture.AT_WALL[kind](palette, rng), rng)
    table = (
        floor.try_free(furniture.ON_FLOOR["dining table"](palette, rng), rng, 10, 0.1) if rng.random() < 0.6 else None
    )
    if table is not None:
        _chairs_around(palette, rng, floor, table)
    for kind in rng.permutation(list(furniture.ON_FLOOR)[1:])[: int(rng.integers(1, 5))]:
        floor.try_free(furniture.ON_FLOOR[kind](palette, rng), rng, 8)
    for _ in range(int(rng.integers(2, 7))):
        floor.try_at_wall(fittings.ON_WALL[str(rng.choice(list(fittings.ON_WALL)))](palette, rng), rng, 8)
    for kind in rng.choice(list(clutter.LOW), int(rng.integers(3, 10))):
        piece = clutter.LOW[kind](palette, rng)
        _ = floor.try_at_wall(piece, rng, 6, gap=0.05) if rng.random() < 0.6 else floor.try_free(piece, rng, 6)
    for place in list(floor.places):
        for top in place.tops:
            litter(palette, rng, floor, top)
    if rng.random() < 0.6:
        centre = floor.outline.mean(axis=0) + rng.normal(0, 0.4, 2)
        lamp = set_down(fittings.pendant(palette, rng, ceiling), *centre)
        if floor.fits(lamp):
            floor.places.append(lamp)


def _chairs_around(palette: Palette, rng: Random, floor: Floor, table: Place) -> None:
    """Chairs at the table's sides, facing it, pushed in by chance."""
    piece = furniture.chair(palette, rng)
    centre, corners = table.plan.mean(axis=0), table.plan
    for i in rng.permutation(4)[: int(rng.integers(1, 5))]:
        side = (corners[i] + corners[(i + 1) % 4]) / 2
        out = (side - centre) / np.linalg.norm(side - centre)
        x, z = side + out * rng.uniform(0.12, 0.4)
        facing = math.degrees(math.atan2(-out[0], -out[1])) + rng.normal(0, 10)
        chair = set_down(piece, x, z, turn_deg=facing)
        if floor.fits(chair):
            floor.places.append(chair)


def litter(palette: Palette, rng: Random, floor: Floor, top: np.ndarray, most: int = 9) -> None:
    """Place small things on a level place: as many as fit of a random few, and now and then one on top of another."""
    x, z, turn, half_x, half_z, y = top
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    taken: list[Place] = []
    for _ in range(int(rng.integers(0, most) * min(1.0, 0.4 + 2 * half_x))):
        piece = clutter.SMALL[str(rng.choice(list(clutter.SMALL)))](palette, rng)
        size = piece.high - piece.low
        if size[0] > 2 * half_x + 0.02 or size[2] > 2 * half_z + 0.06 or size[1] > 0.75:
            continue
        u = rng.uniform(-1, 1) * max(half_x - size[0] / 2, 0)
        v = rng.uniform(-1, 1) * max(half_z - size[2] / 2, 0)
        place = set_down(
            piece, x + c * u + s * v, z - s * u + c * v, y=y + 1e-4, turn_deg=turn + rng.normal(0, 12), margin=0.005
        )
        if any(in_each_other(place, other) for other in taken) or not floor.holds(place.plan):
            continue
        taken.append(place)
    floor.places.extend(taken)
    for place in list(taken):
        for upper in place.tops[:1]:
            if rng.random() < 0.4:
                litter(palette, rng, floor, upper, 2)


# --- The camera ------------------------------------------------------------------------------------------------------


class Seen(NamedTuple):
    """A candidate for a camera, what it sees by boxes: 5, 50 and 95 % distances, and how much lacks to be busy."""

    camera: Camera
    quantiles_m: np.ndarray
    bare: float


def _cameras(rng: Random, floor: Floor, ceiling: float) -> tuple[Camera, ...] | None:
    """Hand-held views, far enough from each other, with the wanted median distances and enough to see."""
    wanted = rng.uniform(*MEDIAN_M, VIEWS_PER_ROOM)
    chosen: list[Camera] = []
    for _ in range(DRAWS):
        seen = _candidates(rng, floor, ceiling)
        while len(chosen) < VIEWS_PER_ROOM:
            free = [other for other in seen if all(_apart(other.camera, camera) for camera in chosen)]
            if not free:
                break
            chosen.append(min(free, key=lambda one: _score(one, wanted[len(chosen)])).camera)
        else:
            return tuple(chosen)
    return None


def _apart(a: Camera, b: Camera) -> bool:
    """Return whether two cameras of a room differ clearly, in place and in direction."""
    turned = a.rotation[:, 2] @ b.rotation[:, 2] < math.cos(math.radians(APART_DEG))
    return bool(turned and np.linalg.norm(a.origin - b.origin) > APART_M)


def _score(seen: Seen, wanted: float) -> float:
    low_end, middle, high_end = seen.quantiles_m
    flat = 2.0 * max(0.0, 0.6 - (high_end - low_end) / middle)
    return abs(middle - wanted) + 3.0 * seen.bare + flat


def _candidates(rng: Random, floor: Floor, ceiling: float) -> list[Seen]:
    """Random views from free places whose distances are in range; judged on boxes, in a 16 x 12 image."""
    low, high = floor.outline.min(axis=0), floor.outline.max(axis=0)
    boxes = Boxes(floor.places)
    has_body = [bool(p.piece.surfaces) and not p.piece.surfaces[0].name.startswith(FLAT) for p in floor.places]
    standing = np.flatnonzero(has_body)
    heads = np.array([_head(rng, low + 0.3, high - 0.3) for _ in range(CANDIDATES)])
    points, y = heads[:, :2], heads[:, 2]
    roomy = floor.inside(points) & (floor.distances(points) >= 0.25)
    heads = heads[roomy & ~boxes.meet_head(points, HEAD_M, y, 0.2)]
    cameras, distances, busy = [], [], []
    for head in heads:
        camera = _camera(*head)
        rays = camera.rays().reshape(-1, 3)
        to_walls = to_shell(floor, ceiling, camera.origin, rays)
        if to_walls.min() < NEAREST_M:
            continue
        to_boxes = boxes.distance(camera.origin, rays)
        distance = np.minimum(to_walls, to_boxes.min(axis=1, initial=np.inf))
        if distance.min() >= NEAREST_M:
            cameras.append(camera)
            distances.append(distance)
            busy.append((to_boxes[:, standing].min(axis=1, initial=np.inf) < to_walls - 0.1).mean())
    if not cameras:
        return []
    *quantiles, farthest = np.quantile(distances, (0.05, 0.5, 0.95, 0.99), axis=1)
    good = (farthest <= FARTHEST_M) & (quantiles[1] >= MEDIAN_M[0] - OFF_M) & (np.array(busy) >= MIN_BUSY)
    bare = np.maximum(0.0, 0.6 - np.array(busy))
    return [Seen(cameras[i], np.array(quantiles)[:, i], float(bare[i])) for i in np.flatnonzero(good)]


def _head(rng: Random, low: np.ndarray, high: np.ndarray) -> tuple[float, ...]:
    """Draw where a person might look from and how: x, z, y, heading, pitch, roll [rad] and field of view [deg]."""
    x, z = rng.uniform(low, high)
    y, heading = rng.uniform(0.9, 1.75), rng.uniform(0, 2 * np.pi)
    return x, z, y, heading, math.radians(rng.normal(-17, 8)), rng.normal(0, 0.02), rng.uniform(*FOV_DEG)


def _camera(x: float, z: float, y: float, heading: float, pitch: float, roll: float, fov: float) -> Camera:
    ahead = np.array((math.cos(pitch) * math.sin(heading), math.sin(pitch), math.cos(pitch) * math.cos(heading)))
    up = (roll * math.cos(heading), 1.0, -roll * math.sin(heading))
    origin = np.array((x, y, z))
    return Camera.look_at(origin, origin + ahead, fov_deg=fov, width=16, height=12, up=up)


def pieces(scene: Scene) -> set[str]:
    """Return kinds of things in a scene: what stands before the colon in its surfaces' names."""
    return {surface.name.split(":")[0] for surface in scene.surfaces if ":" in surface.name}


__all__ = ["Piece", "furnish", "litter", "pieces", "room_view"]
