"""Plants, vases, flowers, candles, toys, sculptures: small things that are there to be looked at.

Each stands on y = 0 around the origin, about life size.
"""

from __future__ import annotations

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.blobs import branching, stone, toy
from scenes.library.things.palette import pick
from scenes.library.things.parts import Palette, Piece, Random, joined, lathe, moved, sheet, tube, turned


def vase_profile(rng: Random, height: float, radius: float) -> list[tuple[float, float]]:
    """Return a random vase: foot, belly, neck and lip."""
    belly, neck = rng.uniform(0.25, 0.6), rng.uniform(0.3, 0.8)
    t = np.linspace(0, 1, 14)
    r = (
        radius
        * (0.55 + 0.45 * np.exp(-(((t - belly) / 0.28) ** 2)))
        * np.where(t > belly, 1 - (1 - neck) * (np.maximum(t - belly, 0) / (1 - belly)) ** 1.5, 1)
    )
    return [(0.0, 0.0), *zip(r.tolist(), (height * t).tolist(), strict=True), (0.85 * float(r[-1]), height * 0.985)]


def vase(palette: Palette, rng: Random) -> Piece:
    height = rng.uniform(0.12, 0.38)
    body = lathe(vase_profile(rng, height, rng.uniform(0.04, 0.09)), 28)
    return Piece((joined("vase: body", pick(palette, rng, "gloss" if rng.random() < 0.6 else "clay"), body),))


def flowers(palette: Palette, rng: Random) -> Piece:
    """Return a vase with dry twigs or tall flowers in it."""
    base = vase(palette, rng)
    high = float(base.high[1])
    stems, heads = [], []
    for _ in range(int(rng.integers(4, 10))):
        lean = rng.normal(0, 0.16, 2)
        s = np.linspace(0, 1, 9)
        long = rng.uniform(0.18, 0.4)
        line = np.column_stack((lean[0] * s**1.5, high * 0.6 + long * s, lean[1] * s**1.5))
        stems.append(tube(line, 0.0022, 6))
        heads.append(moved(shapes.sphere(rng.uniform(0.008, 0.028), 2), line[-1]))
    return Piece(
        (
            *base.surfaces,
            joined("flowers: stems", pick(palette, rng, "leaf"), *stems),
            joined("flowers: heads", pick(palette, rng, "cloth"), *heads),
        )
    )


def _leaf(rng: Random, long: float, wide: float) -> shapes.Shape:
    """Build a pointed leaf that grows along +x and bends down."""
    s, t = np.linspace(0, 1, 8), np.array((-1.0, 0.0, 1.0))
    width = wide * np.sin(np.pi * np.clip(s, 0.02, 0.99)) ** 0.8
    droop = rng.uniform(0.1, 0.7)
    x = long * s[:, None] + 0 * t
    y = long * (0.5 * s - droop * s**2)[:, None] - 0.15 * wide * (1 - np.abs(t))
    return sheet(np.stack((x, y, width[:, None] * t), axis=-1))


def plant(palette: Palette, rng: Random) -> Piece:
    """Return a pot plant: leaves on stems that fan out, from a hand's to a man's height."""
    high = rng.uniform(0.2, 1.5) ** 1.2
    radius = 0.05 + 0.09 * high
    pot_high = 0.09 + 0.16 * high
    vessel = lathe(
        [
            (0.0, 0.0),
            (0.75 * radius, 0.0),
            (radius, pot_high),
            (0.9 * radius, pot_high),
            (0.86 * radius, 0.85 * pot_high),
            (0.0, 0.85 * pot_high),
        ],
        24,
    )
    leaves, stems = [], []
    count = int(rng.integers(8, 26))
    slender = rng.random() < 0.35
    for i in range(count):
        angle, rise = 137.5 * i, rng.uniform(0.15, 1.0)
        foot = np.array((0.0, 0.8 * pot_high, 0.0))
        if slender:
            long = rng.uniform(0.5, 0.95) * high
            blade = turned(_leaf(rng, long, 0.03 + 0.015 * high), "z", rng.uniform(25, 70))
            leaves.append(turned(blade, "y", angle, foot))
            continue
        out = (0.1 + 0.22 * rng.random()) * high
        tip = np.array((out, (1 - 0.3 * rng.random()) * rise * (high - pot_high), 0.0))
        bend = tip * (0.35, 0.75, 1.0)
        s = np.linspace(0, 1, 6)[:, None]
        curve = 2 * s * (1 - s) * bend + s**2 * tip
        stems.append(turned((curve, np.empty((0, 3), np.int64), curve), "y", angle, foot)[0])
        blade = turned(
            _leaf(rng, rng.uniform(0.14, 0.3) * high**0.7, rng.uniform(0.03, 0.08) * high**0.7),
            "z",
            rng.uniform(-30, 40),
        )
        leaves.append(turned(moved(blade, tip), "y", angle, foot))
    surfaces = [
        joined("plant: pot", pick(palette, rng, "clay" if rng.random() < 0.6 else "gloss"), vessel),
        joined("plant: leaves", pick(palette, rng, "leaf"), *leaves),
    ]
    if stems:
        surfaces.append(
            joined("plant: stems", pick(palette, rng, "leaf"), *(tube(line, 0.002 + 0.002 * high, 6) for line in stems))
        )
    return Piece(tuple(surfaces))


def candles(palette: Palette, rng: Random) -> Piece:
    """Return candles, or rods in a stand: thin upright things of different heights."""
    sticks = [
        shapes.cylinder(
            (x, 0, z), (x + rng.normal(0, 0.004), rng.uniform(0.1, 0.3), z), rng.uniform(0.004, 0.012), segments=10
        )
        for x, z in rng.uniform(-0.07, 0.07, (int(rng.integers(3, 8)), 2))
    ]
    plate = lathe([(0.0, 0.0), (0.11, 0.0), (0.11, 0.008), (0.0, 0.008)], 28)
    return Piece(
        (
            joined("candles: wax", pick(palette, rng, "paint"), *sticks),
            joined("candles: plate", palette["steel"], plate),
        )
    )


def soft_toy(palette: Palette, rng: Random) -> Piece:
    return Piece((joined("toy: plush", pick(palette, rng, "cloth"), toy(rng, rng.uniform(0.15, 0.4))),))


def sculpture(palette: Palette, rng: Random) -> Piece:
    return Piece(
        (
            joined(
                "sculpture: stone",
                pick(palette, rng, "clay" if rng.random() < 0.6 else "gloss"),
                stone(rng, rng.uniform(0.15, 0.45)),
            ),
        )
    )


def root(palette: Palette, rng: Random) -> Piece:
    """Return a branch or an antler, standing."""
    return Piece((joined("root: wood", pick(palette, rng, "wood"), branching(rng, rng.uniform(0.2, 0.5))),))
