"""Large things of a room: what stands along its walls, on its floor, and hangs on walls and ceiling.

What stands at a wall has its back at z = 0 and its front towards +z; the rest is centred on the origin.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from scenes import living_room as living
from scenes import shapes
from scenes.blobs import bag, rounded_box
from scenes.model import Material, Surface
from scenes.parts import Palette, Piece, Random, box, joined, lathe, moved, panel, post, sheet, tube, turned


def pick(palette: Palette, rng: Random, family: str) -> Material:
    """One of the palette's materials named `family` and a number or word."""
    names = [name for name in palette if name.startswith(f"{family} ")]
    return palette[names[int(rng.integers(len(names)))]]


def repainted(palette: Palette, rng: Random) -> Palette:
    """The palette with other woods, cloths and paints under the names that the demo room's furniture asks for."""
    varied = {"wood": "wood", "varnished wood": "satin", "white paint": "paint", "sofa cloth": "cloth"}
    varied |= {"cushion cloth": "cloth", "leather": "dark", "rubber": "satin", "clay": "clay"}
    return {**palette, **{name: pick(palette, rng, family) for name, family in varied.items()}}


# --- At a wall -------------------------------------------------------------------------------------------------------


def sofa(palette: Palette, rng: Random) -> Piece:
    """A sofa for two or three, sometimes with a cushion, a blanket or a bag on it."""
    width = rng.uniform(1.4, 2.3)
    own = repainted(palette, rng)
    surfaces = living.sofa(own, width, own["sofa cloth"], depth=rng.uniform(0.75, 0.95))
    for x in rng.uniform(0.35 - width / 2, width / 2 - 0.35, int(rng.integers(0, 4))):
        pillow = turned(rounded_box((0.42, 0.36, 0.14), 3.0), "x", -18, (x, 0.46, 0.26))
        surfaces.append(joined("cushion: cloth", pick(palette, rng, "cloth"), turned(pillow, "y", rng.uniform(-8, 8))))
    return Piece(tuple(surfaces))


def armchair(palette: Palette, rng: Random) -> Piece:
    own = repainted(palette, rng)
    return Piece(tuple(living.sofa(own, rng.uniform(0.8, 1.0), own["sofa cloth"])))


def bookshelf(palette: Palette, rng: Random) -> Piece:
    width, height = rng.uniform(0.6, 1.8), rng.uniform(0.9, 2.2)
    surfaces = living.bookshelf(repainted(palette, rng), rng, width, height)
    return Piece(tuple(surfaces), ((0, 0.14, width / 2 - 0.05, 0.12, height),))


def drawers(palette: Palette, rng: Random) -> Piece:
    """A chest of drawers, a sideboard, a filing cabinet or a nightstand: a body, fronts with gaps, and handles."""
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
    """A board on legs or trestles, with a block of drawers or a back panel."""
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
    """A bed whose head is at the wall: frame, mattress, a wavy blanket that hangs over the sides, pillows."""
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
    """A flat screen on a low board."""
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


def radiator(palette: Palette, rng: Random) -> Piece:
    wide, tall = rng.uniform(0.6, 1.4), rng.uniform(0.4, 0.65)
    x = np.arange(-wide / 2, wide / 2, 0.05)
    fins = [box((a, 0.12, 0.03), (a + 0.038, 0.12 + tall, 0.12)) for a in x]
    pipes = [shapes.cylinder((a, 0, 0.07), (a, 0.14, 0.07), 0.012, segments=10) for a in (x[0], x[-1] + 0.03)]
    return Piece((joined("radiator: fins", pick(palette, rng, "paint"), *fins, *pipes),))


def wall_window(palette: Palette, rng: Random) -> Piece:
    """A bright window: an emitting pane behind a frame and a pane of glass, a sill, and often curtains or a blind."""
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
        joined("window: sky", palette["sky"], sky, emission=living.WINDOW_RADIANCE),
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
    """A door in its frame, shut or a little open, with a handle."""
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
    """A board with hooks and coats that hang from them, at breast height."""
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
    """A framed picture or a poster at eye level."""
    wide, tall = rng.uniform((0.3, 0.3), (1.1, 0.8))
    own = repainted(palette, rng) | {"painting": pick(palette, rng, "print" if rng.random() < 0.4 else "painting")}
    y = rng.uniform(1.55, 1.7) - tall / 2
    surfaces = living.picture(own, wide, tall, bar=rng.uniform(0.015, 0.05))
    return Piece(tuple(living.placed(surfaces, 0, 0, y=y)))


def shelf(palette: Palette, rng: Random) -> Piece:
    """One or two boards on the wall, with brackets."""
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
        tuple(living.table(repainted(palette, rng), top, width, depth)),
        ((0, 0, width / 2 - 0.08, depth / 2 - 0.08, top),),
    )


def coffee_table(palette: Palette, rng: Random) -> Piece:
    width, depth, top = rng.uniform((0.6, 0.45, 0.35), (1.2, 0.7, 0.48))
    surfaces = living.table(repainted(palette, rng), top, width, depth)
    if rng.random() < 0.5:
        lower = box((-width / 2 + 0.08, 0.12, -depth / 2 + 0.08), (width / 2 - 0.08, 0.135, depth / 2 - 0.08))
        surfaces.append(joined("table: shelf", pick(palette, rng, "wood"), lower))
    return Piece(tuple(surfaces), ((0, 0, width / 2 - 0.06, depth / 2 - 0.06, top),))


def chair(palette: Palette, rng: Random) -> Piece:
    return Piece(tuple(living.chair(repainted(palette, rng), rng.uniform(0.42, 0.48), rng.uniform(0.82, 1.1))))


def office_chair(palette: Palette, rng: Random) -> Piece:
    """Five feet on castors, a gas spring, a seat and a curved back."""
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
    """A round seat on three or four slanted legs."""
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
    return Piece(tuple(living.floor_lamp(repainted(palette, rng) | {"brushed steel": palette["steel"]})))


def clothes_horse(palette: Palette, rng: Random) -> Piece:
    """A folding rack of 8 mm rods with some washing on it."""
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
    """A bean bag, a sack or a heap of laundry."""
    return Piece((joined("heap: cloth", pick(palette, rng, "cloth"), bag(rng, rng.uniform(0.25, 0.6))),))


def rug(palette: Palette, rng: Random) -> Piece:
    return Piece(tuple(living.rug(palette, *rng.uniform((0.8, 1.2), (1.6, 2.4)))))


def pendant(palette: Palette, rng: Random, height: float) -> Piece:
    """A lamp on a wire from the ceiling at `height`."""
    drop, radius = rng.uniform(0.4, 1.0), rng.uniform(0.12, 0.28)
    y = height - drop
    profile = ((radius, y), (0.8 * radius, y + 0.12), (0.25 * radius, y + 0.2), (0.02, y + 0.22))
    wire = shapes.cylinder((0, y + 0.2, 0), (0, height, 0), 0.004, segments=6)
    bulb = moved(shapes.sphere(0.04, 2), (0, y + 0.08, 0))
    surfaces = (
        joined("pendant: shade", pick(palette, rng, "paint" if rng.random() < 0.5 else "satin"), lathe(profile, 28)),
        joined("pendant: wire", pick(palette, rng, "dark"), wire),
        joined("pendant: bulb", palette["sky"], bulb, emission=living.LAMP_RADIANCE),
    )
    return Piece(surfaces)


AT_WALL = {
    "sofa": sofa, "armchair": armchair, "bookshelf": bookshelf, "drawers": drawers, "wardrobe": wardrobe, "desk": desk,
    "bed": bed, "television": television, "radiator": radiator, "coats": coats,
}  # fmt: skip
ON_WALL = {"picture": hanging_picture, "shelf": shelf, "clock": clock}
ON_FLOOR = {
    "dining table": dining_table, "coffee table": coffee_table, "chair": chair, "office chair": office_chair,
    "stool": stool, "floor lamp": floor_lamp, "clothes horse": clothes_horse, "heap": heap,
}  # fmt: skip
