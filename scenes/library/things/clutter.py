"""Small things that stand on tables, shelves and floors. Each stands on y = 0 around the origin, about life size."""

from __future__ import annotations

import math

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.blobs import bag, blend
from scenes.library.things.ornaments import candles, flowers, plant, root, sculpture, soft_toy, vase, vase_profile
from scenes.library.things.palette import LAMP_RADIANCE, pick
from scenes.library.things.parts import Palette, Piece, Random, box, joined, lathe, moved, panel, placed, tube, turned


def bowl(palette: Palette, rng: Random) -> Piece:
    """Return a bowl, often with fruit."""
    radius, tall = rng.uniform(0.08, 0.16), rng.uniform(0.05, 0.1)
    t = np.linspace(0, 1, 9)
    outside = [(radius * (0.4 + 0.6 * math.sqrt(s)), tall * s) for s in t]
    inside = [(0.95 * r, 0.06 * tall + 0.94 * y) for r, y in reversed(outside)]
    body = lathe([(0.0, 0.0), *outside, *inside, (0.0, 0.06 * tall)], 28)
    surfaces = [joined("bowl: body", pick(palette, rng, "gloss"), body)]
    if rng.random() < 0.7:
        fruit = []
        for angle in np.linspace(0, 2 * np.pi, int(rng.integers(3, 7)), endpoint=False):
            r = rng.uniform(0.03, 0.04)
            fruit.append(
                moved(
                    shapes.sphere(r, 3),
                    (0.5 * radius * math.cos(angle), 0.55 * tall + r, 0.5 * radius * math.sin(angle)),
                )
            )
        surfaces.append(joined("bowl: fruit", pick(palette, rng, "satin"), *fruit))
    return Piece(tuple(surfaces))


def mug(palette: Palette, rng: Random) -> Piece:
    radius, tall = rng.uniform(0.035, 0.05), rng.uniform(0.07, 0.12)
    body = lathe(
        [(0.0, 0.0), (radius, 0.0), (radius, tall), (0.92 * radius, tall), (0.9 * radius, 0.006), (0.0, 0.006)], 24
    )
    a = np.linspace(-1.3, 1.3, 11)
    ear = np.column_stack((radius - 0.003 + 0.028 * np.cos(a), tall * (0.5 + 0.33 * np.sin(a)), 0 * a))
    return Piece((joined("mug: body", pick(palette, rng, "gloss"), body, tube(ear, 0.005, 8)),))


def bottle(palette: Palette, rng: Random) -> Piece:
    """Return a bottle or a drinking glass, of glass or opaque."""
    tall, radius = rng.uniform(0.18, 0.33), rng.uniform(0.028, 0.042)
    if rng.random() < 0.35:
        profile = [(0.0, 0.0), (0.8 * radius, 0.0), (radius, 0.45 * tall)]
    else:
        s = np.linspace(0, np.pi, 7)
        shoulder = [(radius * (0.68 + 0.32 * math.cos(a)), tall * (0.62 + 0.07 * a / np.pi * 3)) for a in s]
        profile = [(0.0, 0.0), (radius, 0.0), *shoulder, (0.36 * radius, tall)]
    return Piece(
        (
            joined(
                "bottle: body",
                palette["glass"] if rng.random() < 0.6 else pick(palette, rng, "gloss"),
                lathe(profile, 24),
            ),
        )
    )


def pot(palette: Palette, rng: Random) -> Piece:
    """Return a cooking pot or pan with handles, of metal."""
    radius, tall = rng.uniform(0.08, 0.14), rng.uniform(0.04, 0.16)
    body = lathe(
        [(0.0, 0.0), (radius, 0.0), (radius, tall), (0.96 * radius, tall), (0.95 * radius, 0.01), (0.0, 0.01)], 32
    )
    if tall < 0.08:
        grips = [
            tube(np.array(((radius, 0.85 * tall, 0), (radius + 0.1, tall, 0), (radius + 0.2, 1.1 * tall, 0))), 0.009, 8)
        ]
    else:
        a = np.linspace(-1.3, 1.3, 9)
        loop = np.column_stack((radius - 0.006 + 0.035 * np.cos(a), 0 * a + 0.8 * tall, 0.045 * np.sin(a)))
        grips = [tube(loop, 0.006, 8), tube(loop * (-1, 1, 1), 0.006, 8)]
    return Piece(
        (joined("pot: body", palette["steel"], body), joined("pot: grips", pick(palette, rng, "dark"), *grips))
    )


def book_stack(palette: Palette, rng: Random) -> Piece:
    """Return books lying on each other, each turned a little."""
    y, surfaces = 0.0, []
    for _ in range(int(rng.integers(2, 8))):
        wide, thick, deep = rng.uniform((0.13, 0.012, 0.18), (0.22, 0.05, 0.3))
        book = turned(box((-wide / 2, 0, -deep / 2), (wide / 2, thick, deep / 2)), "y", rng.normal(0, 9), (0, y, 0))
        surfaces.append(
            joined("books: cover", pick(palette, rng, "book cover" if rng.random() < 0.8 else "print"), book)
        )
        y += thick
    return Piece(tuple(surfaces), ((0, 0, 0.05, 0.07, y),))


def book_row(palette: Palette, rng: Random) -> Piece:
    """Return upright books, the last one leaning."""
    x, surfaces = 0.0, []
    count = int(rng.integers(3, 10))
    for i in range(count):
        thick, tall, deep = rng.uniform((0.015, 0.17, 0.12), (0.05, 0.28, 0.19))
        book = box((0, 0, -deep / 2), (thick, tall, deep / 2))
        lean = i == count - 1 and rng.random() < 0.6
        book = turned(book, "z", 16, (x + 0.28 * tall, 0, 0)) if lean else moved(book, (x, 0, 0))
        surfaces.append(joined("books: cover", pick(palette, rng, "book cover"), book))
        x += thick + 0.001
    return Piece(tuple(placed(surfaces, -x / 2, 0)))


def box_stack(palette: Palette, rng: Random) -> Piece:
    """Return cardboard boxes stacked carelessly; the top one may stand open."""
    y, surfaces, size = 0.0, [], rng.uniform((0.3, 0.2, 0.25), (0.55, 0.4, 0.45))
    count = int(rng.integers(1, 4))
    for i in range(count):
        w, h, d = size / 2 * (1, 2, 1)
        parts = [box((-w, y, -d), (w, y + h, d))]
        if i == count - 1 and rng.random() < 0.6:
            flaps = ((w, 0.0), (-w, 180.0))
            parts += [
                turned(box((0, 0, -d), (w, 0.004, d)), "z", 55 if a == 0 else 125, (x, y + h, 0)) for x, a in flaps
            ]
        surfaces.append(
            joined("boxes: card", pick(palette, rng, "card"), *(turned(p, "y", rng.normal(0, 3)) for p in parts))
        )
        y += h
        size = size * rng.uniform(0.6, 1.0, 3)
    return Piece(tuple(surfaces), ((0, 0, 0.5 * float(w), 0.5 * float(d), y),) if len(parts) == 1 else ())


def laptop(palette: Palette, rng: Random) -> Piece:
    wide, deep, open_deg = rng.uniform(0.3, 0.38), rng.uniform(0.21, 0.26), rng.uniform(95, 125)
    base = box((-wide / 2, 0, -deep / 2), (wide / 2, 0.016, deep / 2))
    lid = turned(box((-wide / 2, 0, 0), (wide / 2, 0.008, deep)), "x", -open_deg, (0, 0.016, -deep / 2))
    screen = panel((0, 0.0005, deep / 2), (-wide / 2 + 0.012, 0, 0), (0, 0, deep / 2 - 0.015))
    screen = turned(moved(screen, (0, -0.0015, 0)), "x", -open_deg, (0, 0.016, -deep / 2))
    keys = panel((0, 0.0168, -0.01), (wide / 2 - 0.03, 0, 0), (0, 0, -0.27 * deep))
    surfaces = (
        joined("laptop: body", palette["steel"] if rng.random() < 0.5 else pick(palette, rng, "dark"), base, lid),
        joined("laptop: screen", pick(palette, rng, "print"), screen),
        joined("laptop: keys", pick(palette, rng, "dark"), keys),
    )
    return Piece(surfaces)


def monitor(palette: Palette, rng: Random) -> Piece:
    wide = rng.uniform(0.45, 0.7)
    tall, y = 0.58 * wide, rng.uniform(0.1, 0.16)
    shell = box((-wide / 2, y, -0.02), (wide / 2, y + tall, 0.015))
    foot = lathe([(0.0, 0.0), (0.12, 0.0), (0.12, 0.01), (0.02, 0.02), (0.02, y + 0.05), (0.0, y + 0.05)], 24)
    front = panel((0, y + tall / 2, 0.0165), (wide / 2 - 0.012, 0, 0), (0, tall / 2 - 0.012, 0))
    keyboard = box((-0.21, 0, 0.15), (0.21, 0.018, 0.28))
    surfaces = (
        joined("monitor: shell", pick(palette, rng, "dark"), shell, moved(foot, (0, 0, -0.03)), keyboard),
        joined("monitor: screen", pick(palette, rng, "print"), front),
    )
    return Piece(surfaces)


def table_lamp(palette: Palette, rng: Random) -> Piece:
    tall, radius = rng.uniform(0.3, 0.5), rng.uniform(0.09, 0.15)
    low = tall - rng.uniform(0.14, 0.2)
    foot = lathe([*vase_profile(rng, low - 0.02, 0.06)[:-1], (0.008, low - 0.02), (0.008, low + 0.06)], 20)
    shade = lathe([(radius, low), (0.7 * radius, tall)], 28)
    surfaces = (
        joined("table lamp: foot", pick(palette, rng, "gloss"), foot),
        joined("table lamp: shade", palette["lamp cloth"], shade, emission=LAMP_RADIANCE),
    )
    return Piece(surfaces)


def pencils(palette: Palette, rng: Random) -> Piece:
    """Return a cup with pencils, brushes or cooking spoons."""
    tall = rng.uniform(0.08, 0.14)
    cup = lathe([(0.0, 0.0), (0.04, 0.0), (0.042, tall), (0.039, tall), (0.038, 0.004), (0.0, 0.004)], 20)
    sticks = []
    for angle in rng.uniform(0, 2 * np.pi, int(rng.integers(4, 10))):
        lean = rng.uniform(0.3, 1.0) * 0.036
        top = np.array((math.cos(angle) * lean * 2.2, tall * rng.uniform(1.5, 2.3), math.sin(angle) * lean * 2.2))
        sticks.append(shapes.cylinder((-0.4 * top[0], 0.005, -0.4 * top[2]), top, 0.0038, segments=8))
    return Piece(
        (
            joined("pencils: cup", pick(palette, rng, "gloss"), cup),
            joined("pencils: sticks", pick(palette, rng, "wood"), *sticks),
        )
    )


def cable(palette: Palette, rng: Random) -> Piece:
    """Return a cable in loose loops."""
    t = np.linspace(0, 1, 70)
    turns, radius = rng.uniform(1.2, 3.0), rng.uniform(0.06, 0.2)
    r = radius * (0.6 + 0.4 * np.sin(3.1 * t + rng.uniform(0, 6)))
    a = 2 * np.pi * turns * t
    line = np.column_stack((r * np.cos(a), 0.006 + 0.012 * t, r * np.sin(a)))
    return Piece((joined("cable: sheath", pick(palette, rng, "dark"), tube(line, 0.004, 6)),))


def basket(palette: Palette, rng: Random) -> Piece:
    """Return a basket of thin wires, sometimes with a bundle in it."""
    radius, tall = rng.uniform(0.1, 0.2), rng.uniform(0.15, 0.35)
    a = np.linspace(0, 2 * np.pi, 29)
    rings = [
        tube(
            np.column_stack(
                (
                    (0.75 + 0.25 * s) * radius * np.cos(a),
                    0 * a + 0.004 + s * tall,
                    (0.75 + 0.25 * s) * radius * np.sin(a),
                )
            ),
            0.003,
            6,
        )
        for s in np.linspace(0, 1, 6)
    ]
    ribs = [
        shapes.cylinder(
            (0.75 * radius * math.cos(b), 0, 0.75 * radius * math.sin(b)),
            (radius * math.cos(b), tall, radius * math.sin(b)),
            0.0025,
            segments=6,
        )
        for b in np.linspace(0, 2 * np.pi, 18, endpoint=False)
    ]
    surfaces = [
        joined("basket: wires", palette["steel"] if rng.random() < 0.6 else pick(palette, rng, "dark"), *rings, *ribs)
    ]
    if rng.random() < 0.6:
        inside = bag(rng, 0.8 * tall)
        fits = 1.2 * radius / max(np.ptp(inside[0][:, 0]), np.ptp(inside[0][:, 2]))
        surfaces.append(
            joined("basket: cloth", pick(palette, rng, "cloth"), (inside[0] * (fits, 1, fits), *inside[1:]))
        )
    return Piece(tuple(surfaces))


def bin_(palette: Palette, rng: Random) -> Piece:
    radius, tall = rng.uniform(0.1, 0.16), rng.uniform(0.25, 0.4)
    body = lathe(
        [(0.0, 0.0), (0.8 * radius, 0.0), (radius, tall), (0.95 * radius, tall), (0.77 * radius, 0.01), (0.0, 0.01)], 28
    )
    return Piece((joined("bin: body", palette["steel"] if rng.random() < 0.4 else pick(palette, rng, "satin"), body),))


def toy_bricks(palette: Palette, rng: Random) -> Piece:
    """Return a few wooden bricks, cones and balls."""
    surfaces = []
    for _ in range(int(rng.integers(4, 9))):
        at, size = rng.uniform(-0.14, 0.14, 2), rng.uniform(0.025, 0.06)
        kind = rng.integers(4)
        if kind == 0:
            part = moved(shapes.sphere(size / 2, 3), (0, size / 2, 0))
        elif kind == 1:
            part = lathe([(0.0, 0.0), (size / 2, 0.0), (0.0, 1.6 * size)], 20)
        else:
            part = turned(box((-size / 2, 0, -size / 2), (size / 2, size, size / 2)), "y", rng.uniform(0, 90))
        surfaces.append(joined("bricks: wood", pick(palette, rng, "satin"), moved(part, (at[0], 0, at[1]))))
    return Piece(tuple(surfaces))


def shoes(palette: Palette, rng: Random) -> Piece:
    """Return a pair of shoes: rounded lumps with an open top."""
    parts = []
    for x in (-0.07, 0.07):
        s = np.linspace(0, 1, 9)
        balls = np.column_stack((0 * s + x, 0.04 + 0.02 * s, 0.14 - 0.26 * s))
        heel = np.array(((x, 0.08, -0.11), (x, 0.1, -0.06)))
        parts.append((np.concatenate((balls, heel)), np.concatenate((0.045 - 0.004 * s, (0.045, 0.042)))))
    pair = [blend(points, radii, 24) for points, radii in parts]
    low = min(shape[0][:, 1].min() for shape in pair)
    return Piece(
        (joined("shoes: leather", pick(palette, rng, "dark"), *(moved(shape, (0, -low, 0)) for shape in pair)),)
    )


def globe(palette: Palette, rng: Random) -> Piece:
    """Return a ball on a stand: a globe, or a football on the floor."""
    radius = rng.uniform(0.1, 0.16)
    if rng.random() < 0.5:
        return Piece(
            (joined("ball: rubber", pick(palette, rng, "satin"), moved(shapes.sphere(radius, 4), (0, radius, 0))),)
        )
    a = np.linspace(-1.4, 1.4, 15)
    arc = np.column_stack((1.12 * radius * np.cos(a), 1.35 * radius + 1.12 * radius * np.sin(a), 0 * a))
    foot = lathe([(0.0, 0.0), (0.6 * radius, 0.0), (0.1 * radius, 0.02), (0.08 * radius, 0.3 * radius)], 20)
    surfaces = (
        joined("globe: ball", pick(palette, rng, "gloss"), moved(shapes.sphere(radius, 4), (0, 1.35 * radius, 0))),
        joined("globe: stand", palette["steel"], tube(arc, 0.006, 8), foot),
    )
    return Piece(surfaces)


def parcel(palette: Palette, rng: Random) -> Piece:
    """Return a box of any proportions: a loudspeaker, a carton, a radio."""
    w, h, d = rng.uniform((0.08, 0.06, 0.06), (0.3, 0.3, 0.22))
    surfaces = [
        joined(
            "parcel: box",
            pick(palette, rng, "satin" if rng.random() < 0.5 else "card"),
            box((-w / 2, 0, -d / 2), (w / 2, h, d / 2)),
        )
    ]
    if h > 0.15 and rng.random() < 0.5:
        cone = turned(
            lathe([(0.0, -0.01), (0.36 * min(w, h), 0.004), (0.38 * min(w, h), 0.0)], 24), "x", 90, (0, h / 2, d / 2)
        )
        surfaces.append(joined("parcel: cone", pick(palette, rng, "dark"), cone))
    return Piece(tuple(surfaces), ((0, 0, 0.3 * w, 0.3 * d, h),))


def broom(palette: Palette, rng: Random) -> Piece:
    """Return a broom, a rake or skis: a long stick that leans back towards a wall at -z."""
    long, lean = rng.uniform(1.3, 1.8), rng.uniform(8, 14)
    sticks = [
        shapes.cylinder((x, 0.02, 0), (x, long, 0), 0.012, segments=10)
        for x in ((0.0,) if rng.random() < 0.6 else (-0.06, 0.06))
    ]
    head = box((-0.14, 0, -0.03), (0.14, 0.07, 0.03))
    back = [turned(part, "x", -lean, (0, 0, 0)) for part in (*sticks, head)]
    return Piece((joined("broom: stick", pick(palette, rng, "wood"), *back),))


SMALL = {
    "vase": vase, "flowers": flowers, "bowl": bowl, "mug": mug, "bottle": bottle, "pot": pot, "books lying": book_stack,
    "books upright": book_row, "laptop": laptop, "monitor": monitor, "table lamp": table_lamp, "candles": candles,
    "pencils": pencils, "toy": soft_toy, "sculpture": sculpture, "root": root, "bricks": toy_bricks, "globe": globe,
    "parcel": parcel, "plant": plant,
}  # fmt: skip
LOW = {
    "boxes": box_stack, "plant": plant, "basket": basket, "bin": bin_, "toy": soft_toy, "ball": globe, "shoes": shoes,
    "cable": cable, "bricks": toy_bricks, "books lying": book_stack, "root": root, "broom": broom,
}  # fmt: skip
