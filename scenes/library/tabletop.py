"""Eight still lifes on a table before a wall, 1.3 to 2.9 m away: coarse bodies and structure finer than a pixel.

A test set in the spirit of Middlebury's: spikes, antlers, sticks, handles, books and skittles, each scene with a seed
of its own that never changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scenes.errors import require
from scenes.geometry import shapes
from scenes.library.layout import Floor, set_down
from scenes.library.rooms import one_of_each
from scenes.library.things import clutter
from scenes.library.things.blobs import branching, stone, toy
from scenes.library.things.palette import make_palette, pick
from scenes.library.things.parts import (
    Palette,
    Piece,
    Random,
    box,
    joined,
    lathe,
    moved,
    panel,
    tube,
    turned,
    with_normals,
)
from scenes.library.things.patterns import on_one_sheet
from scenes.model import Camera, Scene, Surface

FOV_DEG = 32.0
EYE_M, PITCH_DEG = 0.5, -11.0  # above the table's top
WALL_M = 2.7
STAGE = np.array(((-0.7, -2.55), (0.7, -2.55), (0.36, -1.3), (-0.36, -1.3)))  # where things stand, (x, z)


def spikes(palette: Palette, rng: Random) -> Piece:
    """Return a board bristling with cones and nails."""
    parts = [box((-0.16, 0, -0.12), (0.16, 0.02, 0.12))]
    for x in np.linspace(-0.14, 0.14, 8):
        for z in np.linspace(-0.1, 0.1, 6):
            tall, thick = rng.uniform(0.05, 0.28), rng.uniform(0.003, 0.011)
            parts.append(moved(lathe([(thick, 0.0), (0.0, tall)], 10), (x, 0.02, z)))
    return Piece((joined("spikes: board", pick(palette, rng, "paint"), *parts),))


def skittle(palette: Palette, rng: Random) -> Piece:
    """Return a bowling pin, upright or lying."""
    heights = np.array((0, 0.02, 0.1, 0.2, 0.3, 0.42, 0.55, 0.68, 0.8, 0.92, 0.98, 1.0)) * 0.36
    radii = np.array((0.6, 0.75, 0.95, 1.0, 0.93, 0.7, 0.45, 0.36, 0.4, 0.36, 0.2, 0.0)) * 0.06
    body = lathe(list(zip(radii, heights, strict=True)), 28)
    if rng.random() < 0.25:
        body = moved(turned(body, "z", 90), (0.18, 0.06, 0))
    return Piece((joined("skittle: wood", pick(palette, rng, "gloss" if rng.random() < 0.7 else "paint"), body),))


def antlers(palette: Palette, rng: Random) -> Piece:
    high = rng.uniform(0.3, 0.55)
    return Piece((joined("antlers: horn", pick(palette, rng, "wood"), branching(rng, high, tines=7, thick=0.035)),))


def sticks(palette: Palette, rng: Random) -> Piece:
    """Build thin rods fallen over each other, as in the game."""
    parts = []
    for _ in range(int(rng.integers(10, 22))):
        angle, long = rng.uniform(0, np.pi), rng.uniform(0.12, 0.2)
        low, high = 0.004 + rng.uniform(0, 0.02), 0.004 + rng.uniform(0, 0.09)
        c, s = math.cos(angle) * long, math.sin(angle) * long
        parts.append(shapes.cylinder((-c, low, -s), (c, high, s), rng.uniform(0.002, 0.004), segments=8))
    return Piece((joined("sticks: wood", pick(palette, rng, "paint"), *parts),))


def reeds(palette: Palette, rng: Random) -> Piece:
    """Return upright grass or wires in a foot: fans of 2 to 5 mm."""
    foot = lathe([(0.0, 0.0), (0.06, 0.0), (0.04, 0.05), (0.0, 0.05)], 24)
    stems = []
    for _ in range(int(rng.integers(12, 26))):
        t = np.linspace(0, 1, 9)
        lean, long = rng.normal(0, 0.16, 2), rng.uniform(0.25, 0.55)
        stems.append(
            tube(np.column_stack((lean[0] * t**2, 0.04 + long * t, lean[1] * t**2)), rng.uniform(0.001, 0.0025), 6)
        )
    return Piece(
        (
            joined("reeds: foot", pick(palette, rng, "clay"), foot),
            joined("reeds: stems", pick(palette, rng, "leaf"), *stems),
        )
    )


def rings(palette: Palette, rng: Random) -> Piece:
    """Return standing and lying hoops."""
    parts = []
    for _ in range(int(rng.integers(2, 5))):
        radius, a = rng.uniform(0.04, 0.11), np.linspace(0, 2 * np.pi, 37)
        hoop = tube(np.column_stack((radius * np.cos(a), radius * np.sin(a), 0 * a)), rng.uniform(0.004, 0.01), 10)
        parts.append(
            turned(hoop, "y", rng.uniform(0, 180), (rng.uniform(-0.08, 0.08), radius + 0.008, rng.uniform(-0.06, 0.06)))
        )
    return Piece((joined("rings: metal", palette["steel"], *parts),))


def figure(palette: Palette, rng: Random) -> Piece:
    shape = toy(rng, rng.uniform(0.2, 0.36)) if rng.random() < 0.5 else stone(rng, rng.uniform(0.2, 0.42))
    return Piece((joined("figure: body", pick(palette, rng, "clay" if rng.random() < 0.5 else "cloth"), shape),))


def crate(palette: Palette, rng: Random) -> Piece:
    """Return a slatted box one can look through."""
    w, h, d = rng.uniform((0.1, 0.12, 0.08), (0.2, 0.3, 0.14))
    parts = [box((sx - 0.008, 0, sz - 0.008), (sx + 0.008, h, sz + 0.008)) for sx in (-w, w) for sz in (-d, d)]
    for y in np.linspace(0.01, h - 0.03, max(3, int(h / 0.05))):
        parts += [box((-w, y, z - 0.004), (w, y + 0.02, z + 0.004)) for z in (-d - 0.008, d + 0.008)]
        parts += [box((x - 0.004, y, -d), (x + 0.004, y + 0.02, d)) for x in (-w - 0.008, w + 0.008)]
    return Piece((joined("crate: slats", pick(palette, rng, "wood"), *parts),), ((0, 0, 0.6 * w, 0.6 * d, 0.011),))


Maker = Callable[[Palette, Random], Piece]
C = clutter
# What a scene is made of, largest first: half as often as each maker is tried.
RECIPES: dict[str, tuple[tuple[Maker, int], ...]] = {
    "antlers": ((antlers, 4), (figure, 2), (C.candles, 2), (C.vase, 2), (C.book_stack, 2), (C.toy_bricks, 2)),
    "spikes": ((spikes, 3), (C.parcel, 2), (C.globe, 1), (C.plant, 1), (sticks, 3), (C.candles, 3)),
    "skittles": ((skittle, 11), (C.globe, 2), (C.box_stack, 1), (rings, 2), (C.toy_bricks, 1)),
    "library": ((C.book_row, 3), (C.book_stack, 5), (C.table_lamp, 1), (C.pencils, 3), (figure, 1), (C.mug, 2)),
    "kitchen": ((C.pot, 4), (C.bottle, 5), (C.bowl, 3), (C.mug, 4), (C.pencils, 2), (C.basket, 1)),
    "nursery": ((figure, 4), (C.soft_toy, 3), (C.toy_bricks, 4), (C.globe, 1), (rings, 2), (crate, 1)),
    "greenhouse": ((C.flowers, 3), (reeds, 5), (C.vase, 3), (crate, 2), (C.root, 2), (C.sculpture, 1)),
    "workshop": ((crate, 3), (C.basket, 2), (C.cable, 3), (sticks, 3), (C.pencils, 3), (spikes, 1), (C.parcel, 3)),
}
SCENES = tuple(RECIPES)


def tabletop(name: str, *, width: int = 88, height: int = 72) -> Scene:
    """Return the still life of that name (one of SCENES); the same bytes for the same name."""
    require(name in SCENES, f"tabletop scene {name!r}, expected one of {', '.join(SCENES)}")
    rng = np.random.default_rng(np.random.SeedSequence(SCENES.index(name), spawn_key=(2006,)))
    palette = make_palette(rng)
    floor = Floor(STAGE)
    for make, count in RECIPES[name]:
        for _ in range(2 * count):
            _stand(make(palette, rng), floor, rng)
    # dark: of a hidden lamp's light a trace would come round the table, and be all the ambient light there is
    hidden = [replace(surface, emission=0.0) for surface in one_of_each(palette)]
    surfaces = _table(palette) + [s for place in floor.places for s in place.surfaces] + hidden
    pitch = math.radians(PITCH_DEG)
    ahead = (0.0, EYE_M + math.sin(pitch), -math.cos(pitch))
    camera = Camera.look_at((0, EYE_M, 0), ahead, fov_deg=FOV_DEG, width=width, height=height)
    surfaces = with_normals(on_one_sheet(surfaces))
    return Scene(f"tabletop/{name}", tuple(surfaces), camera, notes=("procedural, fixed seed",))


def _stand(piece: Piece, floor: Floor, rng: Random, tries: int = 30) -> None:
    """Place the piece on the stage, tall things rather at the back, sometimes on top of what offers a place."""
    tops = [top for place in floor.places for top in place.tops]
    if tops and rng.random() < 0.3:
        x, z, turn, half_x, half_z, y = tops[int(rng.integers(len(tops)))]
        size = piece.high - piece.low
        if size[0] < 2 * half_x + 0.08 and size[2] < 2 * half_z + 0.08:
            place = set_down(piece, x, z, y=y + 1e-4, turn_deg=turn + rng.normal(0, 15))
            if floor.fits(place):
                floor.places.append(place)
                return
    tall = float(piece.high[1])
    back, front = STAGE[:, 1].min(), STAGE[:, 1].max() - 0.7 * min(tall, 0.5)
    for _ in range(tries):
        z = rng.uniform(back, front)
        place = set_down(piece, rng.uniform(-0.6, 0.6), z, turn_deg=rng.uniform(-40, 40), margin=0.004)
        if floor.fits(place):
            floor.places.append(place)
            return


def _table(palette: Palette) -> list[Surface]:
    """Table top and wall, larger than the image."""
    top = panel((0, 0, -1.5), (2.0, 0, 0), (0, 0, -1.2))
    back = panel((0, 0.8, -WALL_M), (2.0, 0, 0), (0, 1.2, 0))
    cloth = replace(palette["wall"], name="cloth")
    return [joined("table top", palette["floor"], top), joined("back wall", cloth, back)]
