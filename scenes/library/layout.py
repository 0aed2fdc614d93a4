"""Decide where things may stand: plan views as convex quadrilaterals, a room's outline, what a camera would see of
both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from scenes.library.things.parts import Piece, Random, placed
from scenes.model import Surface


@dataclass(frozen=True, eq=False)
class Place:
    """A piece that stands at (x, z), height y, turned about the vertical; its plan is 4 points (x, z).

    The surfaces are moved only when they are asked for: most places that are tried are taken already.
    """

    piece: Piece
    at: tuple[float, float, float]  # x, y, z
    turn_deg: float
    plan: np.ndarray
    low: float
    high: float

    @property
    def surfaces(self) -> list[Surface]:
        x, y, z = self.at
        return placed(list(self.piece.surfaces), x, z, y=y, turn_deg=self.turn_deg)

    @cached_property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x and z of the plan, as plain numbers: most pairs of places are told apart by these."""
        (x0, z0), (x1, z1) = self.plan.min(axis=0).tolist(), self.plan.max(axis=0).tolist()
        return x0, z0, x1, z1

    @property
    def tops(self) -> np.ndarray:
        """Rows of x, z, turn [deg], half width, half depth and y of the level places on it."""
        x, y, z = self.at
        rows = [
            (*_turn(np.array((tx, tz)), self.turn_deg, (x, z)), self.turn_deg, half_x, half_z, y + ty)
            for tx, tz, half_x, half_z, ty in self.piece.tops
        ]
        return np.array(rows, float).reshape(-1, 6)


def set_down(piece: Piece, x: float, z: float, *, y: float = 0.0, turn_deg: float = 0.0, margin: float = 0.0) -> Place:
    """Return the piece there; its plan is its bounding rectangle and a margin around it."""
    low, high = piece.low, piece.high
    x0, z0, x1, z1 = low[0] - margin, low[2] - margin, high[0] + margin, high[2] + margin
    corners = np.array(((x0, z0), (x1, z0), (x1, z1), (x0, z1)))
    at = (float(x), float(y), float(z))
    return Place(piece, at, turn_deg, _turn(corners, turn_deg, (x, z)), y + low[1], y + high[1])


def _turn(points: np.ndarray, turn_deg: float, by: tuple[float, float]) -> np.ndarray:
    """Plan points turned as `placed` turns: positive from +z towards +x."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    x, z = points[..., 0], points[..., 1]
    return np.stack((c * x + s * z + by[0], -s * x + c * z + by[1]), axis=-1)


def _onward(polygon: np.ndarray) -> np.ndarray:
    """Return the corner after each corner (`np.roll`, whose generality takes longer than all else here)."""
    return np.concatenate((polygon[1:], polygon[:1]))


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two convex polygons (n, 2) share more than a border: no edge of either separates them."""
    if (a.max(axis=0) <= b.min(axis=0)).any() or (b.max(axis=0) <= a.min(axis=0)).any():
        return False
    for polygon in (a, b):
        edge = _onward(polygon) - polygon
        normal = np.stack((edge[:, 1], -edge[:, 0]))
        pa, pb = a @ normal, b @ normal
        if ((pa.max(axis=0) <= pb.min(axis=0) + 1e-6) | (pb.max(axis=0) <= pa.min(axis=0) + 1e-6)).any():
            return False
    return True


@dataclass(eq=False)
class Floor:
    """An outline (n, 2) of points (x, z) that turns from +x towards +z, and what stands in it."""

    outline: np.ndarray
    places: list[Place] = field(default_factory=list)

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        return self.outline, _onward(self.outline)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether each point (n, 2) lies inside the outline (even-odd rule)."""
        (ax, az), (bx, bz) = (corners.T for corners in self.edges)
        x, z = points[:, :1], points[:, 1:]
        crosses = (az > z) != (bz > z)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = ax + (z - az) / (bz - az) * (bx - ax)
        return (crosses & (x < at)).sum(axis=1) % 2 == 1

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return from each point (n, 2) to the outline."""
        a, b = self.edges
        along, to = b - a, points[:, None] - a
        t = np.clip((to * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
        return np.linalg.norm(t[..., None] * along - to, axis=2).min(axis=1)

    def holds(self, points: np.ndarray, slack: float = 1e-3) -> bool:
        """Return whether all points lie inside the outline, or within `slack` of it."""
        out = ~self.inside(points)
        return not out.any() or bool((self.distances(points[out]) <= slack).all())

    def fits(self, place: Place) -> bool:
        """Return inside, and clear of everything that stands at the same height."""
        if any(in_each_other(place, other) for other in self.places):
            return False
        corners_in = self.holds(np.concatenate((place.plan, place.plan.mean(axis=0, keepdims=True))))
        return corners_in and not _inside_any(place.plan, self.outline)

    def try_at_wall(
        self, piece: Piece, rng: Random, tries: int = 12, gap: float = 0.01, margin: float = 0.03
    ) -> Place | None:
        """Return the piece somewhere along a wall that is long enough, its back to it."""
        a, b = self.edges
        low, high = piece.low, piece.high
        long = np.linalg.norm(b - a, axis=1)
        wide = float(high[0] - low[0])
        usable = np.flatnonzero(long > wide + 0.02)
        for _ in range(tries if len(usable) else 0):
            i = int(rng.choice(usable, p=long[usable] / long[usable].sum()))
            along = (b[i] - a[i]) / long[i]
            inward = np.array((-along[1], along[0]))
            s = rng.uniform(wide / 2, long[i] - wide / 2)
            x, z = a[i] + s * along + (gap - min(float(low[2]), 0.0)) * inward
            turn = math.degrees(math.atan2(inward[0], inward[1]))
            place = set_down(piece, x, z, turn_deg=turn, margin=0)
            if self.fits(place):
                self.places.append(set_down(piece, x, z, turn_deg=turn, margin=margin))
                return place
        return None

    def try_free(
        self, piece: Piece, rng: Random, tries: int = 12, margin: float = 0.05, turn_deg: float | None = None
    ) -> Place | None:
        """Return the piece anywhere on the floor, turned at random."""
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        for _ in range(tries):
            turn = rng.uniform(0, 360) if turn_deg is None else turn_deg
            x, z = rng.uniform(low + 0.1, high - 0.1)
            place = set_down(piece, x, z, turn_deg=turn, margin=margin)
            if self.fits(place):
                self.places.append(place)
                return place
        return None


def in_each_other(a: Place, b: Place) -> bool:
    """Return whether two places share heights and ground."""
    if a.low >= b.high or b.low >= a.high:
        return False
    (x0, z0, x1, z1), (u0, w0, u1, w1) = a.extent, b.extent
    return x0 < u1 and u0 < x1 and z0 < w1 and w0 < z1 and overlap(a.plan, b.plan)


def _inside_any(polygon: np.ndarray, points: np.ndarray) -> bool:
    """Return whether any of the points lies well inside a convex polygon."""
    edge = _onward(polygon) - polygon
    offset = points[:, None] - polygon
    away = (edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0]) / np.linalg.norm(edge, axis=1)
    return bool(((away > 0.02).all(axis=1) | (away < -0.02).all(axis=1)).any())


def to_shell(floor: Floor, ceiling: float, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return distance along unit rays (n, 3) to walls, floor and ceiling."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_level = np.where(rays[:, 1] < 0, -origin[1] / rays[:, 1], (ceiling - origin[1]) / rays[:, 1])
        nearest = np.where(np.abs(rays[:, 1]) < 1e-9, np.inf, to_level)
        return np.minimum(nearest, _edge_hits(*floor.edges, origin[[0, 2]], rays[:, [0, 2]]).min(axis=1))


class Boxes:
    """Upright boxes around what stands in a room: all their plans are rectangles."""

    def __init__(self, places: Sequence[Place]) -> None:
        plans = np.array([place.plan for place in places]).reshape(-1, 4, 2)
        sides = (plans[:, 1] - plans[:, 0]) / 2, (plans[:, 3] - plans[:, 0]) / 2
        self.centre = plans.mean(axis=1)
        # a point p of the plan has (p - centre) . axis in -1 to 1, for both axes
        self.axes = tuple(side / np.maximum((side**2).sum(axis=1, keepdims=True), 1e-12) for side in sides)
        self.low, self.high = (np.array([getattr(place, end) for place in places]) for end in ("low", "high"))
        self.extent = np.array([place.extent for place in places]).reshape(-1, 4)

    def meet_head(self, points: np.ndarray, half: float, y: np.ndarray, over: float) -> np.ndarray:
        """Return whether anything that reaches half the height y is in the square column around each point (n, 2).

        The column's sides are 2 `half` and along the axes; it goes from the floor to `over` above y.
        """
        (px, pz), (u0, w0, u1, w1) = points.T[..., None], self.extent.T
        meets = (px - half < u1) & (px + half > u0) & (pz - half < w1) & (pz + half > w0)
        meets &= (self.low < y[:, None] + over) & (self.high > 0.5 * y[:, None])
        for axis in self.axes:
            # the square's half width along this side of a box, in units of half the box
            reach = half * np.abs(axis).sum(axis=1)
            meets &= np.abs(((points[:, None] - self.centre) * axis).sum(axis=2)) < 1 + reach
        return meets.any(axis=1)

    def distance(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return distance along unit rays (n, 3) to each box, (n, boxes), inf where it is missed: three slabs a box."""
        ground, flat = origin[[0, 2]], rays[:, [0, 2]]
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = _sorted((self.low - origin[1]) / rays[:, 1:2], (self.high - origin[1]) / rays[:, 1:2])
            for axis in self.axes:
                at, rate = ((ground - self.centre) * axis).sum(axis=1), flat @ axis.T
                first, last = _sorted((-1 - at) / rate, (1 - at) / rate)
                enter, leave = np.maximum(enter, first), np.minimum(leave, last)
        t = np.where(enter > 1e-6, enter, leave)
        return np.where((leave >= enter) & (t > 1e-6), t, np.inf)


def _sorted(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.minimum(a, b), np.maximum(a, b)


def _edge_hits(a: np.ndarray, b: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance (rays, edges) along plan rays to the segments a to b, inf where they are missed."""
    along, to = b - a, a - start
    det = direction[:, :1] * along[:, 1] - direction[:, 1:] * along[:, 0]
    t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / det
    s = (to[:, 0] * direction[:, 1:] - to[:, 1] * direction[:, :1]) / det
    return np.where((t > 1e-6) & (s >= 0) & (s <= 1), t, np.inf)
