"""Primary vertices: x1, the first surface of a pixel, and what it reflects of points that the laser lights."""

from __future__ import annotations

from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Interactions, Masks, UInts
from render.indirect.glossy import camera_share, ratio_at_camera
from render.indirect.launch_layout import BLOCK
from render.indirect.light_vertices import (
    Connection,
    LightVertices,
    connect_to_light_vertex,
    connects_suffixes,
    light_vertex_index,
    reflect,
    reflect_diffusely,
)
from render.indirect.path_space_filter import Point
from render.scene.traced_scene import Float, TracedScene, dr


class PrimaryVertices(NamedTuple):
    """x1 of every path of a launch and where it belongs; as a `point` of `path_space_filter`, if that is asked for.

    `late_m` is the path from the laser to x1 [m] up to which light comes by the suffixes of the whole block, where
    the vertex `allows_reuse`, and not by the path alone: infinite where blocks share all, 0 where they share nothing.
    """

    receiver: UInts
    si: Interactions
    transmission: Floats
    path: Floats
    valid: Masks
    allows_reuse: Masks
    late_m: Floats
    point: Point | None

    @property
    def is_filtered(self) -> bool:
        """Return whether late light is filtered: of light vertices x1 then gets diffuse light alone."""
        return self.point is not None

    @property
    def early_m(self) -> Array:
        """Return `late_m` of the vertices that allow reuse, 0 for others."""
        return dr.select(self.allows_reuse, self.late_m, 0)


def reuses_early_paths(world: TracedScene) -> bool:
    """Return whether blocks share what comes too early to be filtered: under a lamp that is little of the light."""
    return not connects_suffixes(world)


def connect_primary_vertices(
    world: TracedScene,
    primary: PrimaryVertices,
    light_vertices: LightVertices | None,
    batch: UInts,
    first: UInts,
    connections: int,
) -> tuple[Connection, ...]:
    """Connect x1 to light vertices, each with a part of their light. No loop: one would be a kernel of its own."""
    found: list[Connection] = []
    if light_vertices is None:
        return ()
    reflected = reflect_diffusely if primary.is_filtered else reflect
    for number in range(connections):
        point = light_vertex_index(light_vertices, batch, first + number)
        arrival = connect_to_light_vertex(world, primary.si, light_vertices, point, primary.valid, reflected)
        both = sampling_techniques(primary, arrival.path) * arrival.lobes + connections * arrival.density
        light = arrival.light * arrival.value / both
        if arrival.ratio is not None:
            density = None if primary.is_filtered else arrival.lobes
            at_x1 = ratio_at_camera(world, primary.si, arrival.direction, primary.valid, density)
            light *= camera_share(arrival.ratio * at_x1)
        light = dr.select(dr.isfinite(light), light * primary.transmission, 0)
        found.append(Connection(light, arrival.path, arrival.direction, primary.valid))
    return tuple(found)


def sampling_techniques(primary: PrimaryVertices, path: Floats) -> Array:
    """Count the BSDF-sampling techniques that can generate a path of this length: BLOCK or 1.

    BLOCK where the block reuses that path. The number enters the balance heuristic.
    """
    return dr.select(path < primary.early_m, Float(BLOCK), Float(1))
