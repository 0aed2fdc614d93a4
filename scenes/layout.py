"""Where things may stand: plan views as convex quadrilaterals, a room's outline, what a camera would see of both."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from scenes.model import Surface
from scenes.parts import Piece, Random, placed


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
    """The piece there; its plan is its bounding rectangle and a margin around it."""
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


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex polygons (n, 2) share more than a border: no edge of either separates them."""
    if (a.max(axis=0) <= b.min(axis=0)).any() or (b.max(axis=0) <= a.min(axis=0)).any():
        return False
    for polygon in (a, b):
        edge = np.roll(polygon, -1, axis=0) - polygon
        normal = np.column_stack((edge[:, 1], -edge[:, 0]))
        pa, pb = a @ normal.T, b @ normal.T
        if ((pa.max(axis=0) <= pb.min(axis=0) + 1e-6) | (pb.max(axis=0) <= pa.min(axis=0) + 1e-6)).any():
            return False
    return True


@dataclass(eq=False)
class Floor:
    """An outline (n, 2) of points (x, z) that turns from +x towards +z, and what stands in it."""

    outline: np.ndarray
    places: list[Place] = field(default_factory=list)

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        return self.outline, np.roll(self.outline, -1, axis=0)

    def holds(self, points: np.ndarray, slack: float = 1e-3) -> bool:
        """Whether all points lie inside the outline (even-odd rule), or within `slack` of it."""
        a, b = self.edges()
        for x, z in points:
            crosses = (a[:, 1] > z) != (b[:, 1] > z)
            with np.errstate(divide="ignore", invalid="ignore"):
                at = a[:, 0] + (z - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
            if (crosses & (x < at)).sum() % 2 == 0 and self.distance(np.array((x, z))) > slack:
                return False
        return True

    def distance(self, point: np.ndarray) -> float:
        """From a point to the outline."""
        a, b = self.edges()
        along = b - a
        t = np.clip(((point - a) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        return float(np.linalg.norm(a + t[:, None] * along - point, axis=1).min())

    def fits(self, place: Place) -> bool:
        """Inside, and clear of everything that stands at the same height."""
        clear = (
            other.low >= place.high or other.high <= place.low or not overlap(place.plan, other.plan)
            for other in self.places
        )
        corners_in = self.holds(np.concatenate((place.plan, place.plan.mean(axis=0, keepdims=True))))
        inside_out = any(_inside(place.plan, corner) for corner in self.outline)
        return corners_in and not inside_out and all(clear)

    def try_at_wall(
        self, piece: Piece, rng: Random, tries: int = 12, gap: float = 0.01, margin: float = 0.03
    ) -> Place | None:
        """The piece somewhere along a wall that is long enough, its back to it."""
        a, b = self.edges()
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
        """The piece anywhere on the floor, turned at random."""
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        for _ in range(tries):
            turn = rng.uniform(0, 360) if turn_deg is None else turn_deg
            x, z = rng.uniform(low + 0.1, high - 0.1)
            place = set_down(piece, x, z, turn_deg=turn, margin=margin)
            if self.fits(place):
                self.places.append(place)
                return place
        return None


def _inside(polygon: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point lies well inside a convex polygon."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    away = edge[:, 0] * (point - polygon)[:, 1] - edge[:, 1] * (point - polygon)[:, 0]
    away = away / np.linalg.norm(edge, axis=1)
    return bool((away > 0.02).all() or (away < -0.02).all())


def rough_distance(floor: Floor, ceiling: float, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance along unit rays (n, 3) to walls, floor, ceiling, and the upright boxes around what stands there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_level = np.where(rays[:, 1] < 0, -origin[1] / rays[:, 1], (ceiling - origin[1]) / rays[:, 1])
        nearest = np.where(np.abs(rays[:, 1]) < 1e-9, np.inf, to_level)
        start, direction = origin[[0, 2]], rays[:, [0, 2]]
        nearest = np.minimum(nearest, _edge_hits(*floor.edges(), start, direction).min(axis=1))
        if floor.places:
            plans = np.array([place.plan for place in floor.places])
            low, high = (np.array([getattr(place, end) for place in floor.places]) for end in ("low", "high"))
            t = _edge_hits(plans.reshape(-1, 2), np.roll(plans, -1, axis=1).reshape(-1, 2), start, direction)
            t = t.reshape(len(rays), -1, 4)
            y = origin[1] + t * rays[:, 1, None, None]
            side = np.where((y >= low[:, None]) & (y <= high[:, None]), t, np.inf)
            nearest = np.minimum(nearest, side.min(axis=(1, 2)))
            for level in (low, high):
                t = (level - origin[1]) / rays[:, 1:2]
                inside = _inside_all(plans, start + t[..., None] * direction[:, None])
                nearest = np.minimum(nearest, np.where((t > 0) & inside, t, np.inf).min(axis=1))
    return nearest


def _edge_hits(a: np.ndarray, b: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance (rays, edges) along plan rays to the segments a to b, inf where they are missed."""
    along, to = b - a, a - start
    det = direction[:, :1] * along[:, 1] - direction[:, 1:] * along[:, 0]
    t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / det
    s = (to[:, 0] * direction[:, 1:] - to[:, 1] * direction[:, :1]) / det
    return np.where((t > 1e-6) & (s >= 0) & (s <= 1), t, np.inf)


def _inside_all(polygons: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (n, p, 2) lie in their convex polygons (p, corners, 2), (n, p)."""
    edge = np.roll(polygons, -1, axis=1) - polygons
    offset = points[:, :, None] - polygons
    side = edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0]
    return (side >= 0).all(axis=2) | (side <= 0).all(axis=2)
