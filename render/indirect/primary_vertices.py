"""The heads of paths: x1, the first surface of a pixel, and what it reflects of points that the laser lights."""

from __future__ import annotations

from typing import Any, NamedTuple

from render.indirect.launch_layout import BLOCK
from render.indirect.light_vertices import LightVertices, is_wide, joined
from render.indirect.path_space_filter import Point
from render.scene.traced_scene import Float, TracedScene, dr


class PrimaryVertices(NamedTuple):
    """x1 of every path of a launch and where it belongs; as a `point` of `path_space_filter`, if that is asked for.

    `late_m` is the path from the laser to x1 [m] up to which light comes by the tails of the whole block, where the
    head `shares`, and not by the path alone: infinite where blocks share all, 0 where they share nothing.
    """

    receiver: Any
    si: Any
    transmission: Any
    path: Any
    valid: Any
    shares: Any
    late_m: Any
    point: Point | None

    @property
    def early_m(self) -> Any:
        """`late_m` of those that share, 0 for others."""
        return dr.select(self.shares, self.late_m, 0)


class Joined(NamedTuple):
    """What x1 reflects of a lit point: radiance, path to the laser, and direction to the point."""

    value: Any
    path: Any
    direction: Any


def shares_early(world: TracedScene) -> bool:
    """Whether blocks share what comes too early to be filtered: under a lamp that is little of the light."""
    return not is_wide(world)


def join_heads(
    world: TracedScene, heads: PrimaryVertices, lit: LightVertices | None, batch: Any, first: Any, joins: int
) -> tuple[Joined, ...]:
    """x1 joined to lit points, each of which has a share of their light. No loop: one would be a kernel of its own."""
    found = []
    for join in range(joins):
        light, path, direction = joined(
            world, heads.si, lit, batch, first + join, heads.valid, lambda path: copies_of(heads, path), joins
        )
        found.append(Joined(light * heads.transmission, path, direction))
    return tuple(found)


def copies_of(heads: PrimaryVertices, path: Any) -> Any:
    """How many lobes look for light that has come so far from the laser to x1: those of the whole block, or one."""
    return dr.select(path < heads.early_m, Float(BLOCK), Float(1))
