"""Large things of a room: what stands along its walls, on its floor, and hangs on walls and ceiling.

What stands at a wall has its back at z = 0 and its front towards +z; the rest is centred on the origin.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from scenes.geometry import shapes
from scenes.library.things import basic_furniture as basic
from scenes.library.things.blobs import bag, rounded_box
from scenes.library.things.fittings import coats, radiator
from scenes.library.things.palette import pick, repainted
from scenes.library.things.parts import Palette, Piece, Random, box, joined, lathe, moved, panel, post, sheet, turned
from scenes.model import Surface

# --- At a wall -------------------------------------------------------------------------------------------------------


def sofa(palette: Palette, rng: Random) -> Piece:
    """Return a sofa for two or three, sometimes with a cushion, a blanket or a bag on it."""
    width = rng.uniform(1.4, 2.3)
    own = repainted(palette, rng)
    surfaces = basic.sofa(own, width, own["sofa cloth"], depth=rng.uniform(0.75, 0.95))
    for x in rng.uniform(0.35 - width / 2, width / 2 - 0.35, int(rng.integers(0, 4))):
        pillow = turned(rounded_box((0.42, 0.36, 0.14), 3.0), "x", -18, (x, 0.46, 0.26))
        surfaces.append(joined("cushion: cloth", pick(palette, rng, "cloth"), turned(pillow, "y", rng.uniform(-8, 8))))
    return Piece(tuple(surfaces))


def armchair(palette: Palette, rng: Random) -> Piece:
    own = repainted(palette, rng)
    return Piece(tuple(basic.sofa(own, rng.uniform(0.8, 1.0), own["sofa cloth"])))


def bookshelf(palette: Palette, rng: Random) -> Piece:
    width, height = rng.uniform(0.6, 1.8), rng.uniform(0.9, 2.2)
    surfaces = basic.bookshelf(repainted(palette, rng), rng, width, height)
    return Piece(tuple(surfaces), ((0, 0.14, width / 2 - 0.05, 0.12, height),))


def drawers(palette: Palette, rng: Random) -> Piece:
    """Draw a chest of drawers, a sideboard, a filing cabinet or a nightstand: a body, fronts with gaps, and handles."""
    wide, tall, deep = rng.uniform((0.4, 0.5, 0.35), (1.6, 1.2, 0.5))
    columns, rows = max(1, round(wide / 0.55)), max(2, round(tall / 0.25))
    body, front = pick(palette, rng, "wood"), pick(palette, rng, "satin" if rng.random() < 0.5 else "paint")
    x, y = np.linspace(-wide / 2 + 0.02, wide / 2 - 0.02, columns + 1), np.linspace(0.08, tall - 0.04, rows + 1)
    fronts, handles = [], []
    for left, right in itertools.pairwise(x):
        for low, high in itertools.pairwise(y):
            fronts.append(box((left + 0.005, low + 0.005, deep - 0.02), (right - 0.005, high - 0.005, deep)))
            middle, at = (left + right) / 2, (low + high) / 2
            handles.append(box((middle - 0.06, at - 0.008, deep), (middle + 0.06, at + 0.008, deep + 0.025)))
    case = box((-wide / 2, 0.05, 0), (wide / 2, tall, deep - 0.022))
    top = box((-wide / 2 - 0.01, tall, 0), (wide / 2 + 0.01, tall + 0.025, deep + 0.01))
    surfaces = (
        joined("drawers: body", body, case, top),
        joined("drawers: fronts", front, *fronts),
        joined("drawers: handles", palette["steel"], *handles),
    )
    return Piece(surfaces, ((0, deep / 2, wide / 2 - 0.05, deep / 2 - 0.04, tall + 0.025),))


def wardrobe(palette: Palette, rng: Random) -> Piece:
    wide, tall, deep = rng.uniform((0.8, 1.8, 0.5), (1.8, 2.2, 0.62))
    doors = max(2, round(wide / 0.5))
    x = np.linspace(-wide / 2, wide / 2, doors + 1)
    paint = pick(palette, rng, "wood" if rng.random() < 0.5 else "paint")
    fronts = [box((a + 0.004, 0.08, deep), (b - 0.004, tall - 0.03, deep + 0.02)) for a, b in itertools.pairwise(x)]
    inset = [
        box((a + 0.08, y, deep + 0.02), (b - 0.08, y + 0.42 * tall, deep + 0.028))
        for a, b in itertools.pairwise(x)
        for y in (0.16, 0.16 + 0.46 * tall)
    ]
    knobs = [moved(shapes.sphere(0.018, 2), (a + 0.05, 0.95, deep + 0.04)) for a in x[:-1]]
    surfaces = [
        joined("wardrobe: body", paint, box((-wide / 2, 0, 0), (wide / 2, tall, deep)), *fronts),
        joined("wardrobe: knobs", palette["steel"], *knobs),
    ]
    if rng.random() < 0.5:
        surfaces.append(joined("wardrobe: panels", pick(palette, rng, "paint"), *inset))
    return Piece(tuple(surfaces), ((0, deep / 2, wide / 2 - 0.1, deep / 2 - 0.05, tall),))


def desk(palette: Palette, rng: Random) -> Piece:
    """Return a board on legs or trestles, with a block of drawers or a back panel."""
    wide, deep, top = rng.uniform((1.0, 0.55, 0.7), (1.8, 0.85, 0.78))
    x = wide / 2 - 0.06
    legs = [post(sx, sz, 0.022, 0, top - 0.03) for sx in (-x, x) for sz in (0.06, deep - 0.06)]
    parts = [joined("desk: board", pick(palette, rng, "satin"), box((-wide / 2, top - 0.03, 0), (wide / 2, top, deep)))]
    parts.append(joined("desk: legs", palette["steel"] if rng.random() < 0.5 else pick(palette, rng, "wood"), *legs))
    if rng.random() < 0.6:
        side = rng.choice((-1, 1)) * (wide / 2 - 0.28)
        block = box((side - 0.2, 0.06, 0.08), (side + 0.2, top - 0.032, deep - 0.05))
        fronts = [box((side - 0.19, y, deep - 0.05), (side + 0.19, y + 0.17, deep - 0.032)) for y in (0.08, 0.27, 0.46)]
        parts.append(joined("desk: drawers", pick(palette, rng, "paint"), block, *fronts))
    return Piece(tuple(parts), ((0, deep / 2, wide / 2 - 0.06, deep / 2 - 0.05, top),))


def bed(palette: Palette, rng: Random) -> Piece:
    """Return a bed whose head is at the wall: frame, mattress, a wavy blanket that hangs over the sides, pillows."""
    wide, long = rng.uniform(0.9, 1.8), rng.uniform(1.9, 2.1)
    half = wide / 2
    frame = box((-half - 0.03, 0.12, 0.02), (half + 0.03, 0.3, long + 0.05))
    head = box((-half - 0.04, 0, 0), (half + 0.04, rng.uniform(0.7, 1.2), 0.06))
    legs = [post(x, z, 0.03, 0, 0.12) for x in (-half, half) for z in (0.05, long)]
    u, v = np.meshgrid(np.linspace(-half - 0.12, half + 0.12, 25), np.linspace(long + 0.04, 0.62, 25))
    fold = np.clip((np.abs(u) - half - 0.01) / 0.1, 0, 1)
    ripple = sum(0.009 * np.sin(a * u + b * v + c) for a, b, c in rng.uniform((-16, -12, 0), (16, 12, 6.3), (5, 3)))
    cover = np.stack(
        (np.clip(u, -half - 0.05, half + 0.05) + 0.01 * np.sign(u) * fold, 0.545 + ripple - 0.26 * fold, v), -1
    )
    pillows = [
        moved(turned(rounded_box((min(0.62, wide / 2 - 0.06), 0.15, 0.4), 3.0), "x", 14), (x, 0.5, 0.34))
        for x in ((-wide / 4, wide / 4) if wide > 1.3 else (0.0,))
    ]
    surfaces = [
        joined("bed: frame", pick(palette, rng, "wood"), frame, head, *legs),
        joined("bed: mattress", pick(palette, rng, "paint"), box((-half, 0.3, 0.06), (half, 0.52, long))),
        joined("bed: blanket", pick(palette, rng, "pattern" if rng.random() < 0.5 else "cloth"), sheet(cover)),
        joined("bed: pillows", pick(palette, rng, "cloth"), *pillows),
    ]
    return Piece(tuple(surfaces), ((0, long * 0.7, half - 0.15, long * 0.2, 0.565),))


def television(palette: Palette, rng: Random) -> Piece:
    """Return a flat screen on a low board."""
    base = drawers(palette, rng)
    _, z, half, _, _ = base.tops[0]
    scale = 0.55 / base.high[1]
    low = [Surface(s.vertices * (1, scale, 1), s.faces, s.material, s.uv, name=s.name) for s in base.surfaces]
    wide = float(np.clip(2 * half, 0.6, 1.2))
    tall, y = wide * 0.57, 0.55
    shell = box((-wide / 2, y + 0.08, z - 0.02), (wide / 2, y + 0.08 + tall, z + 0.02))
    foot = box((-0.15, y, z - 0.1), (0.15, y + 0.015, z + 0.1))
    neck = box((-0.04, y + 0.015, z - 0.02), (0.04, y + 0.09, z + 0.0))
    front = panel((0, y + 0.08 + tall / 2, z + 0.0215), (wide / 2 - 0.02, 0, 0), (0, tall / 2 - 0.02, 0))
    surfaces = (
        *low,
        joined("television: shell", pick(palette, rng, "dark"), shell, foot, neck),
        joined("television: screen", palette["print 0"] if rng.random() < 0.4 else palette["gloss dark"], front),
    )
    return Piece(surfaces, ((-half + 0.05, z, 0.1, 0.1, 0.55),) if half > wide / 2 + 0.2 else ())


# --- On the floor ----------------------------------------------------------------------------------------------------


def dining_table(palette: Palette, rng: Random) -> Piece:
    width, depth, top = rng.uniform((0.9, 0.7, 0.7), (1.9, 1.0, 0.78))
    if rng.random() < 0.3:
        radius = rng.uniform(0.4, 0.65)
        plate = lathe(((0.0, top - 0.03), (radius, top - 0.03), (radius, top), (0.0, top)), 40)
        foot = lathe(((0.3, 0), (0.28, 0.03), (0.05, 0.06), (0.04, top - 0.03)), 20)
        round_one = (
            joined("table: board", pick(palette, rng, "satin"), plate),
            joined("table: foot", palette["steel"], foot),
        )
        return Piece(round_one, ((0, 0, 0.65 * radius, 0.65 * radius, top),))
    return Piece(
        tuple(basic.table(repainted(palette, rng), top, width, depth)),
        ((0, 0, width / 2 - 0.08, depth / 2 - 0.08, top),),
    )


def coffee_table(palette: Palette, rng: Random) -> Piece:
    width, depth, top = rng.uniform((0.6, 0.45, 0.35), (1.2, 0.7, 0.48))
    surfaces = basic.table(repainted(palette, rng), top, width, depth)
    if rng.random() < 0.5:
        lower = box((-width / 2 + 0.08, 0.12, -depth / 2 + 0.08), (width / 2 - 0.08, 0.135, depth / 2 - 0.08))
        surfaces.append(joined("table: shelf", pick(palette, rng, "wood"), lower))
    return Piece(tuple(surfaces), ((0, 0, width / 2 - 0.06, depth / 2 - 0.06, top),))


def chair(palette: Palette, rng: Random) -> Piece:
    return Piece(tuple(basic.chair(repainted(palette, rng), rng.uniform(0.42, 0.48), rng.uniform(0.82, 1.1))))


def office_chair(palette: Palette, rng: Random) -> Piece:
    """Return five feet on castors, a gas spring, a seat and a curved back."""
    seat = rng.uniform(0.43, 0.52)
    arms = [turned(box((0, 0.06, -0.02), (0.3, 0.09, 0.02)), "y", 72 * i + 10) for i in range(5)]
    wheels = [
        moved(shapes.sphere(0.03, 2), (0.28 * math.cos(a), 0.03, -0.28 * math.sin(a)))
        for a in np.radians(72 * np.arange(5) + 10)
    ]
    spring = shapes.cylinder((0, 0.06, 0), (0, seat - 0.04, 0), 0.025, segments=12)
    u, v = np.meshgrid(np.linspace(-1, 1, 13), np.linspace(0, 1, 9))
    back = np.stack((0.22 * u * (1 - 0.15 * v), seat + 0.12 + 0.5 * v, -0.2 - 0.06 * v + 0.06 * u**2), axis=-1)
    behind = moved(sheet(back[:, ::-1]), (0, 0, -0.04))
    rod = box((-0.025, seat - 0.04, -0.26), (0.025, seat + 0.3, -0.24))
    cloth = pick(palette, rng, "dark" if rng.random() < 0.6 else "cloth")
    surfaces = (
        joined("office chair: base", pick(palette, rng, "dark"), *arms, *wheels, rod),
        joined("office chair: spring", palette["steel"], spring),
        joined(
            "office chair: seat",
            cloth,
            moved(rounded_box((0.48, 0.09, 0.46), 5.0), (0, seat - 0.04, 0)),
            sheet(back),
            behind,
        ),
    )
    return Piece(surfaces)


def stool(palette: Palette, rng: Random) -> Piece:
    """Return a round seat on three or four slanted legs."""
    high, radius, count = rng.uniform(0.42, 0.7), rng.uniform(0.15, 0.2), int(rng.integers(3, 5))
    seat = lathe(((0.0, high - 0.03), (radius, high - 0.03), (radius, high), (0.0, high)), 28)
    angles = 2 * np.pi * np.arange(count) / count + 0.4
    legs = [
        shapes.cylinder(
            (1.1 * radius * math.cos(a), 0, 1.1 * radius * math.sin(a)),
            (0.7 * radius * math.cos(a), high - 0.03, 0.7 * radius * math.sin(a)),
            0.014,
            segments=10,
        )
        for a in angles
    ]
    surfaces = (
        joined("stool: seat", pick(palette, rng, "satin"), seat),
        joined("stool: legs", pick(palette, rng, "wood"), *legs),
    )
    return Piece(surfaces, ((0, 0, 0.6 * radius, 0.6 * radius, high),))


def floor_lamp(palette: Palette, rng: Random) -> Piece:
    return Piece(tuple(basic.floor_lamp(repainted(palette, rng) | {"brushed steel": palette["steel"]})))


def clothes_horse(palette: Palette, rng: Random) -> Piece:
    """Return a folding rack of 8 mm rods with some washing on it."""
    wide, high, spread = rng.uniform(0.9, 1.3), rng.uniform(0.85, 1.05), rng.uniform(0.25, 0.35)
    legs = [
        shapes.cylinder((x, 0, -side * spread), (x, high, side * spread), 0.008, segments=8)
        for x in (-wide / 2, wide / 2)
        for side in (-1, 1)
    ]
    rails = [
        shapes.cylinder((-wide / 2, high, z), (wide / 2, high, z), 0.005, segments=8)
        for z in np.linspace(-spread, spread, 7)
    ]
    surfaces = [joined("clothes horse: rods", palette["steel"], *legs, *rails)]
    for z in np.linspace(-spread, spread, 7)[rng.random(7) < 0.4]:
        w, drop, middle = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.5), rng.uniform(-wide / 4, wide / 4)
        u, y = np.meshgrid(np.linspace(-w / 2, w / 2, 11), high - np.linspace(drop, 0, 6))
        wave = z + 0.012 + 0.008 * np.sin(30 * u + rng.uniform(0, 6))
        surfaces.append(
            joined("clothes horse: cloth", pick(palette, rng, "cloth"), sheet(np.stack((middle + u, y, wave), -1)))
        )
    return Piece(tuple(surfaces))


def heap(palette: Palette, rng: Random) -> Piece:
    """Return a bean bag, a sack or a heap of laundry."""
    return Piece((joined("heap: cloth", pick(palette, rng, "cloth"), bag(rng, rng.uniform(0.25, 0.6))),))


def rug(palette: Palette, rng: Random) -> Piece:
    return Piece(tuple(basic.rug(palette, *rng.uniform((0.8, 1.2), (1.6, 2.4)))))


AT_WALL = {
    "sofa": sofa, "armchair": armchair, "bookshelf": bookshelf, "drawers": drawers, "wardrobe": wardrobe, "desk": desk,
    "bed": bed, "television": television, "radiator": radiator, "coats": coats,
}  # fmt: skip
ON_FLOOR = {
    "dining table": dining_table, "coffee table": coffee_table, "chair": chair, "office chair": office_chair,
    "stool": stool, "floor lamp": floor_lamp, "clothes horse": clothes_horse, "heap": heap,
}  # fmt: skip
