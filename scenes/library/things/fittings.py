"""Build what is fixed to a room: windows with curtains and blinds, doors, radiators, hooks, pictures, shelves, lamps.

What belongs to a wall has its back at z = 0 and its front towards +z.
"""

from __future__ import annotations

import numpy as np

from scenes.geometry import shapes
from scenes.library.things import basic_furniture as basic
from scenes.library.things.palette import LAMP_RADIANCE, WINDOW_RADIANCE, pick, repainted
from scenes.library.things.parts import (
    Palette,
    Piece,
    Random,
    box,
    joined,
    lathe,
    moved,
    panel,
    placed,
    sheet,
    tube,
    turned,
)


def radiator(palette: Palette, rng: Random) -> Piece:
    wide, tall = rng.uniform(0.6, 1.4), rng.uniform(0.4, 0.65)
    x = np.arange(-wide / 2, wide / 2, 0.05)
    fins = [box((a, 0.12, 0.03), (a + 0.038, 0.12 + tall, 0.12)) for a in x]
    pipes = [shapes.cylinder((a, 0, 0.07), (a, 0.14, 0.07), 0.012, segments=10) for a in (x[0], x[-1] + 0.03)]
    return Piece((joined("radiator: fins", pick(palette, rng, "paint"), *fins, *pipes),))


def wall_window(palette: Palette, rng: Random) -> Piece:
    """Return a bright window: an emitting pane behind a frame and a pane of glass, a sill, and often curtains or a
    blind."""
    wide, tall, sill = rng.uniform(0.8, 2.0), rng.uniform(0.9, 1.4), rng.uniform(0.7, 1.0)
    x, bar = wide / 2, 0.05
    bars = [
        box((-x - bar, sill - bar, 0), (x + bar, sill, 0.14)),
        box((-x - bar, sill + tall, 0), (x + bar, sill + tall + bar, 0.06)),
    ]
    bars += [
        box((s - bar / 2, sill, 0), (s + bar / 2, sill + tall, 0.06))
        for s in np.linspace(-x, x, int(rng.integers(2, 5)))
    ]
    if rng.random() < 0.5:
        bars.append(box((-x, sill + 0.62 * tall, 0.01), (x, sill + 0.62 * tall + 0.035, 0.05)))
    sky = panel((0, sill + tall / 2, 0.008), (x, 0, 0), (0, tall / 2, 0))
    glass = panel((0, sill + tall / 2, 0.03), (x, 0, 0), (0, tall / 2, 0))
    surfaces = [
        joined("window: frame", pick(palette, rng, "paint"), *bars),
        joined("window: sky", palette["sky"], sky, emission=WINDOW_RADIANCE),
        joined("window: glass", palette["glass"], glass),
    ]
    kind = rng.random()
    cloth = pick(palette, rng, "pattern" if rng.random() < 0.4 else "cloth")
    if kind < 0.5:
        drop = 0.05 if rng.random() < 0.6 else sill - 0.1
        curtains = [
            _curtain(rng, side * (x + 0.15), rng.uniform(0.3, 0.55), drop, sill + tall + 0.12) for side in (-1, 1)
        ]
        rod = shapes.cylinder(
            (-x - 0.45, sill + tall + 0.13, 0.1), (x + 0.45, sill + tall + 0.13, 0.1), 0.012, segments=10
        )
        surfaces += [joined("curtain: cloth", cloth, *curtains), joined("curtain: rod", palette["steel"], rod)]
    elif kind < 0.75:
        low = sill + rng.uniform(0.2, 0.8) * tall
        slats = [box((-x, y, 0.062), (x, y + 0.004, 0.085)) for y in np.arange(low, sill + tall, 0.035)]
        surfaces.append(joined("blind: slats", pick(palette, rng, "paint"), *slats))
    return Piece(tuple(surfaces), ((0, 0.1, x - 0.1, 0.03, sill),) if kind >= 0.75 else ())


def _curtain(rng: Random, x: float, width: float, low: float, high: float) -> shapes.Shape:
    """Hanging folds."""
    u = np.linspace(-0.5, 0.5, 37)
    y = np.linspace(low, high, 7)
    folds = 0.035 * np.sin(2 * np.pi * rng.uniform(4, 6) * u + rng.uniform(0, 6)) + 0.012 * np.sin(31 * u)
    narrow = 1 - rng.uniform(0, 0.35) * np.sin(np.pi * (y - low) / (high - low)) ** 2
    points = np.stack((x + width * narrow[:, None] * u, y[:, None] + 0 * u, 0.1 + 0 * y[:, None] + folds), axis=-1)
    return sheet(points)


def door(palette: Palette, rng: Random) -> Piece:
    """Return a door in its frame, shut or a little open, with a handle."""
    wide, tall = rng.uniform(0.8, 0.95), rng.uniform(2.0, 2.1)
    x = wide / 2
    frame = [box((s - 0.05, 0, 0), (s + 0.05, tall + 0.05, 0.05)) for s in (-x - 0.05, x + 0.05)]
    frame.append(box((-x, tall, 0), (x, tall + 0.05, 0.05)))
    leaf = [box((0, 0.01, 0), (wide, tall, 0.035))]
    if rng.random() < 0.6:
        leaf += [box((0.14, y, 0.035), (wide - 0.14, y + high, 0.043)) for y, high in ((0.2, 0.6), (1.0, tall - 1.2))]
    knob = [
        shapes.cylinder((wide - 0.07, 1.03, 0.03), (wide - 0.07, 1.03, 0.085), 0.012, segments=10),
        box((wide - 0.19, 1.02, 0.075), (wide - 0.06, 1.04, 0.095)),
    ]
    angle = 0.0 if rng.random() < 0.6 else -rng.uniform(8, 50)
    swung = [[turned(part, "y", angle, (-x, 0, 0.01)) for part in parts] for parts in (leaf, knob)]
    surfaces = (
        joined("door: frame", pick(palette, rng, "paint"), *frame),
        joined("door: leaf", pick(palette, rng, "paint" if rng.random() < 0.6 else "wood"), *swung[0]),
        joined("door: handle", palette["steel"], *swung[1]),
    )
    return Piece(surfaces)


def coats(palette: Palette, rng: Random) -> Piece:
    """Return a board with hooks and coats that hang from them, at breast height."""
    count = int(rng.integers(2, 5))
    x = (np.arange(count) - (count - 1) / 2) * 0.24
    board = box((x[0] - 0.15, 1.6, 0), (x[-1] + 0.15, 1.7, 0.025))
    hooks = [tube(np.array(((a, 1.62, 0.02), (a, 1.6, 0.08), (a, 1.64, 0.1))), 0.006, 6) for a in x]
    surfaces = [
        joined("coats: board", pick(palette, rng, "wood"), board),
        joined("coats: hooks", palette["steel"], *hooks),
    ]
    for a in x[rng.random(count) < 0.8]:
        long, u = rng.uniform(0.6, 1.1), np.linspace(-1, 1, 15)
        y = np.linspace(1.62 - long, 1.62, 9)
        spread = 0.05 + 0.14 * np.sqrt(np.linspace(1, 0, 9))
        bulge = 0.08 + 0.06 * np.cos(u * 1.4) + 0.018 * np.sin(9 * u + rng.uniform(0, 6))
        points = np.stack((a + spread[:, None] * u, y[:, None] + 0 * u, 0 * y[:, None] + bulge), axis=-1)
        surfaces.append(
            joined("coats: coat", pick(palette, rng, "cloth" if rng.random() < 0.6 else "dark"), sheet(points))
        )
    return Piece(tuple(surfaces))


def hanging_picture(palette: Palette, rng: Random) -> Piece:
    """Return a framed picture or a poster at eye level."""
    wide, tall = rng.uniform((0.3, 0.3), (1.1, 0.8))
    own = repainted(palette, rng) | {"painting": pick(palette, rng, "print" if rng.random() < 0.4 else "painting")}
    y = rng.uniform(1.55, 1.7) - tall / 2
    surfaces = basic.picture(own, wide, tall, bar=rng.uniform(0.015, 0.05))
    return Piece(tuple(placed(surfaces, 0, 0, y=y)))


def shelf(palette: Palette, rng: Random) -> Piece:
    """Return one or two boards on the wall, with brackets."""
    wide, y = rng.uniform(0.5, 1.2), rng.uniform(1.25, 1.5)
    heights = (y, y + 0.34) if rng.random() < 0.5 else (y,)
    boards = [box((-wide / 2, h, 0), (wide / 2, h + 0.022, 0.22)) for h in heights]
    brackets = [box((x, h - 0.1, 0), (x + 0.015, h, 0.16)) for h in heights for x in (-wide / 3, wide / 3)]
    surfaces = (
        joined("shelf: boards", pick(palette, rng, "wood"), *boards),
        joined("shelf: brackets", palette["steel"], *brackets),
    )
    return Piece(surfaces, tuple((0.0, 0.11, wide / 2 - 0.05, 0.09, h + 0.022) for h in heights))


def clock(palette: Palette, rng: Random) -> Piece:
    radius, y = rng.uniform(0.12, 0.2), rng.uniform(1.7, 1.95)
    face = turned(lathe(((radius, 0), (radius, 0.03), (0.9 * radius, 0.035), (0.0, 0.03)), 28), "x", 90, (0, y, 0))
    hands = [
        turned(box((-0.006, 0, 0.036), (0.006, length * radius, 0.042)), "z", rng.uniform(0, 360), (0, y, 0))
        for length in (0.75, 0.5)
    ]
    return Piece(
        (
            joined("clock: face", pick(palette, rng, "paint"), face),
            joined("clock: hands", pick(palette, rng, "dark"), *hands),
        )
    )


def pendant(palette: Palette, rng: Random, height: float) -> Piece:
    """Return a lamp on a wire from the ceiling at `height`."""
    drop, radius = rng.uniform(0.4, 1.0), rng.uniform(0.12, 0.28)
    y = height - drop
    profile = ((radius, y), (0.8 * radius, y + 0.12), (0.25 * radius, y + 0.2), (0.02, y + 0.22))
    wire = shapes.cylinder((0, y + 0.2, 0), (0, height, 0), 0.004, segments=6)
    bulb = moved(shapes.sphere(0.04, 2), (0, y + 0.08, 0))
    surfaces = (
        joined("pendant: shade", pick(palette, rng, "paint" if rng.random() < 0.5 else "satin"), lathe(profile, 28)),
        joined("pendant: wire", pick(palette, rng, "dark"), wire),
        joined("pendant: bulb", palette["sky"], bulb, emission=LAMP_RADIANCE),
    )
    return Piece(surfaces)


ON_WALL = {"picture": hanging_picture, "shelf": shelf, "clock": clock}
