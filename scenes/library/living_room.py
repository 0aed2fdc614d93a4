"""The default demo scene: a furnished living room made from a seed, no files needed.

The room lies around the origin with the floor at y = 0; the camera looks along -z, turned left towards the
far corner. Every piece of furniture is a small function that builds it around its own origin, standing on y = 0 with
its front towards +z; `placed` turns it and sets it down. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from numbers import Integral

import numpy as np

from scenes.errors import InputError
from scenes.library.things import shapes
from scenes.library.things.parts import Palette, Random, box, joined, panel, placed, post, smooth_normals
from scenes.library.things.patterns import grain, landscape, mottled, planks, rug_pattern
from scenes.material_fields import MaterialFields
from scenes.model import Camera, Material, Scene, Surface, Texture

LOW, HIGH = np.array((-2.05, 0.0, -3.2)), np.array((1.85, 2.5, 3.0))  # the room's corners
TILE_M = 2.0  # edge of the square that one floor or wall texture covers
RUG_M = 0.012  # thickness of the rug

# Steady light near 550 to 700 nm [W/(m^2 sr nm)]. Full sun is 1e5 lx and about 1.5 W/(m^2 nm), so an overcast sky of
# 3,300 cd/m^2 seen through the window is 3.3e3 / 1e5 * 1.5 = 0.05; an 800 to 1,500 lm bulb whose light leaves through
# 0.25 m^2 of cloth is 600 to 1,200 cd/m^2, about 0.01 to 0.02.
WINDOW_RADIANCE = 0.05
LAMP_RADIANCE = 0.02


def living_room(seed: int = 0, *, width: int = 128, height: int = 96) -> Scene:
    """Return a closed, furnished room of 3.9 x 6.2 x 2.5 m seen from 1.4 m above its floor, depths 0.8 to 6.2 m.

    The seed moves and colours the furniture and shapes the sculpture; equal seeds give equal scenes, byte for byte.
    """
    draw = _streams(seed)
    palette = _palette(draw("colours"), draw("textures"))
    surfaces = room(palette) + window(palette)
    surfaces += furniture(palette, draw("places"), draw("books"), draw("sculpture"))
    camera = Camera.look_at((0.0, 1.4, 2.3), (-1.24, 0.72, -0.35), fov_deg=60.0, width=width, height=height)
    return Scene("living-room", tuple(surfaces), camera, notes=(f"procedural, seed {int(seed)}",))


def _streams(seed: int) -> Callable[[str], Random]:
    """Return what gives each purpose its own random stream, so that one more draw here changes nothing there."""
    if not isinstance(seed, Integral) or seed < 0:
        raise InputError(f"living-room: seed {seed!r} is not a whole number of 0 or more")
    purposes = ("colours", "textures", "places", "books", "sculpture")
    return lambda name: np.random.default_rng(np.random.SeedSequence(int(seed), spawn_key=(purposes.index(name),)))


def room(palette: Palette) -> list[Surface]:
    """Return floor, ceiling and four walls, all facing inwards."""
    x, y, z = np.diag((HIGH - LOW) / 2)
    centre = (LOW + HIGH) / 2
    walls = ((-z, x), (z, -x), (-x, -z), (x, z))
    return [
        joined("floor", palette["oak planks"], panel(centre - y, x, -z, TILE_M)),
        joined("ceiling", palette["ceiling paint"], panel(centre + y, x, z)),
        joined("walls", palette["plaster"], *(panel(centre + out, right, y, TILE_M) for out, right in walls)),
    ]


def window(palette: Palette, width: float = 1.3, height: float = 1.15) -> list[Surface]:
    """Return a window on the far wall: an emitting pane behind a painted frame with a cross of bars and a sill."""
    left, right, bottom, top = -0.45 - width / 2, -0.45 + width / 2, 0.95, 0.95 + height
    x, y, z, bar = (left + right) / 2, (bottom + top) / 2, LOW[2], 0.05
    frame = (
        box((left - bar, bottom, z), (left, top, z + 0.05)),
        box((right, bottom, z), (right + bar, top, z + 0.05)),
        box((left - bar, top, z), (right + bar, top + bar, z + 0.05)),
        box((left - 0.1, bottom - bar, z), (right + 0.1, bottom, z + 0.12)),
        box((x - 0.02, bottom, z), (x + 0.02, top, z + 0.04)),
        box((left, y - 0.02, z), (x - 0.02, y + 0.02, z + 0.04)),
        box((x + 0.02, y - 0.02, z), (right, y + 0.02, z + 0.04)),
    )
    half = ((width / 2 - 0.02) / 2, 0, 0), (0, (height / 2 - 0.02) / 2, 0)
    panes = (
        panel((sx, sy, z + 0.02), *half)
        for sx in ((left + x - 0.02) / 2, (right + x + 0.02) / 2)
        for sy in ((bottom + y - 0.02) / 2, (top + y + 0.02) / 2)
    )
    return [
        joined("window: frame", palette["white paint"], *frame),
        joined("window: panes", palette["white paint"], *panes, emission=WINDOW_RADIANCE),
    ]


def furniture(palette: Palette, places: Random, books: Random, form: Random) -> list[Surface]:
    """Return everything that stands in the room, each piece moved and turned a little by the seed."""

    def near(value: float, spread: float) -> float:
        return value + places.uniform(-spread, spread)

    left, back = LOW[0], LOW[2]
    table_x, table_z, radius = near(-0.1, 0.08), near(0.2, 0.1), near(0.16, 0.04)
    table_turn, table_top = near(0, 5), 0.74
    pieces = placed(bookshelf(palette, books), left, near(0.45, 0.1), turn_deg=90)
    pieces += placed(sofa(palette, 1.7, palette["sofa cloth"]), left + 0.03, near(-1.65, 0.08), turn_deg=90)
    pieces += placed(picture(palette), left, near(-1.6, 0.1), y=near(1.15, 0.05), turn_deg=90)
    pieces += placed(sofa(palette, 0.95, palette["leather"]), near(0.0, 0.12), back + 0.15, turn_deg=near(0, 3))
    pieces += placed(floor_lamp(palette), near(-1.05, 0.06), near(-0.45, 0.08))
    pieces += placed(rug(palette), -1.23, near(0.6, 0.05))
    pieces += placed(ball(palette, radius), near(-1.15, 0.1), near(0.45, 0.15), y=RUG_M)
    pieces += placed(table(palette, table_top), table_x, table_z, turn_deg=table_turn)
    pieces += placed(sculpture(palette, form), table_x + near(-0.2, 0.08), table_z + near(-0.05, 0.06), y=table_top)
    pieces += placed(chair(palette), near(-0.12, 0.06), near(1.22, 0.02), turn_deg=180 + near(0, 8))
    return pieces


def table(palette: Palette, top: float, width: float = 1.05, depth: float = 0.75) -> list[Surface]:
    """Return a varnished board with an apron on four square legs."""
    x, z, leg, board = width / 2 - 0.07, depth / 2 - 0.07, 0.0275, top - 0.03
    plate = box((-width / 2, board, -depth / 2), (width / 2, top, depth / 2))
    legs = [post(sx, sz, leg, 0, board) for sx in (-x, x) for sz in (-z, z)]
    rails = [box((leg - x, board - 0.08, sz - 0.01), (x - leg, board, sz + 0.01)) for sz in (-z, z)]
    return [
        joined("table: board", palette["varnished wood"], plate),
        joined("table: legs", palette["wood"], *legs, *rails),
    ]


def chair(palette: Palette, seat: float = 0.45, top: float = 1.0) -> list[Surface]:
    """Return a wooden chair whose back (at -z) has upright slats between two rails."""
    half, post = 0.21, 0.032
    inner = half - post
    posts = [box((-half, 0, -half), (-inner, top, -inner)), box((inner, 0, -half), (half, top, -inner))]
    legs = [box((x, 0, inner), (x + post, seat - 0.03, half)) for x in (-half, inner)]
    rails = [box((-inner, y - 0.05, -half), (inner, y, -half + 0.022)) for y in (top - 0.005, seat + 0.16)]
    slats = [
        box((x - 0.014, seat + 0.16, -half + 0.004), (x + 0.014, top - 0.055, -half + 0.018))
        for x in np.linspace(-inner, inner, 7)[1:-1]
    ]
    cushion = box((-half, seat - 0.03, -inner), (half, seat, half))
    return [
        joined("chair: frame", palette["wood"], *posts, *legs, *rails, *slats),
        joined("chair: seat", palette["varnished wood"], cushion),
    ]


def sofa(palette: Palette, width: float, cover: Material, depth: float = 0.82) -> list[Surface]:
    """Return a sofa with as many seats as its width has room for, its back at z = 0; a narrow one is an armchair."""
    seats = max(1, round((width - 0.4) / 0.65))
    name = "sofa" if seats > 1 else "armchair"
    x, arm, foot, base, seat = width / 2, 0.18, 0.09, 0.28, 0.44
    body = (
        box((-x, foot, 0), (x, base, depth)),
        box((-x, base, 0), (arm - x, 0.6, depth)),
        box((x - arm, base, 0), (x, 0.6, depth)),
        box((arm - x, base, 0), (x - arm, 0.84, 0.2)),
    )
    edges = np.linspace(arm - x, x - arm, seats + 1)
    cushions = [box((a + 0.005, base, 0.2), (b - 0.005, seat, depth + 0.02)) for a, b in pairwise(edges)]
    feet = [post(sx, sz, 0.03, 0, foot) for sx in (0.1 - x, x - 0.1) for sz in (0.1, depth - 0.1)]
    return [
        joined(f"{name}: body", cover, *body),
        joined(f"{name}: cushions", palette["cushion cloth"], *cushions),
        joined(f"{name}: feet", palette["wood"], *feet),
    ]


def bookshelf(palette: Palette, rng: Random, width: float = 1.5, height: float = 2.0) -> list[Surface]:
    """Return a painted case, its back on z = 0, whose five compartments are more or less full of upright books."""
    depth, board, x = 0.28, 0.025, width / 2
    floors = np.linspace(0.06, height - board, 6)
    case = [
        box((-x, 0, 0), (board - x, height, depth)),
        box((x - board, 0, 0), (x, height, depth)),
        box((board - x, 0.06, 0), (x - board, height, 0.012)),
    ]
    case += [box((board - x, y, 0.012), (x - board, y + board, depth - 0.005)) for y in floors]
    covers = [material for name, material in palette.items() if name.startswith("book cover")]
    books: list[list[shapes.Shape]] = [[] for _ in covers]
    for y in floors[:-1] + board:
        at, end = board - x + 0.004, (x - board) - rng.uniform(0.0, 0.5)
        while at + 0.06 < end:
            thick, tall, deep = rng.uniform((0.018, 0.2, 0.13), (0.055, 0.32, 0.2))
            books[rng.integers(len(books))].append(box((at, y, 0.02), (at + thick, y + tall, 0.02 + deep)))
            at += thick + rng.choice((0.001, 0.001, 0.001, 0.04))
    shelved = zip(covers, books, strict=True)
    spines = [joined(f"bookshelf: books, {cover.name}", cover, *parts) for cover, parts in shelved if parts]
    return [joined("bookshelf: case", palette["white paint"], *case), *spines]


def floor_lamp(palette: Palette) -> list[Surface]:
    """Return a round foot, an 18 mm stand, and a cloth shade on a crossbar that glows on its outside."""
    wall, faces, uv = shapes.cylinder((0, 1.36, 0), (0, 1.66, 0), 1.0)
    wall[:, ::2] *= np.interp(wall[:, 1:2], (1.36, 1.66), (0.2, 0.12))
    foot = shapes.cylinder((0, 0, 0), (0, 0.025, 0), 0.14, caps=True)
    stand = shapes.cylinder((0, 0.025, 0), (0, 1.42, 0), 0.009, segments=24)
    reach = float(np.interp(1.43, (1.36, 1.66), (0.2, 0.12))) - 0.002
    bar = box((-reach, 1.42, -0.005), (reach, 1.43, 0.005))
    return [
        joined("lamp: stand", palette["brushed steel"], foot, stand, bar),
        joined("lamp: shade", palette["lamp cloth"], (wall, faces, uv), emission=LAMP_RADIANCE),
    ]


def picture(palette: Palette, width: float = 0.9, height: float = 0.62, bar: float = 0.035) -> list[Surface]:
    """Return a framed painting whose back is on z = 0 and whose lower edge is on y = 0."""
    x, board = width / 2, 0.015
    frame = (
        *(box((-x, y, 0), (x, y + bar, 0.03)) for y in (0, height - bar)),
        *(box((left, bar, 0), (left + bar, height - bar, 0.03)) for left in (-x, x - bar)),
    )
    canvas = panel((0, height / 2, board), (x - bar, 0, 0), (0, height / 2 - bar, 0))
    return [
        joined("picture: frame", palette["wood"], *frame),
        joined("picture: canvas", palette["painting"], canvas),
    ]


def rug(palette: Palette, width: float = 0.9, length: float = 1.4) -> list[Surface]:
    x, z = width / 2, length / 2
    return [joined("rug: wool", palette["rug wool"], box((-x, 0, -z), (x, RUG_M, z)))]


def ball(palette: Palette, radius: float) -> list[Surface]:
    vertices, faces, uv = shapes.sphere(radius, subdivisions=4)
    normals = vertices / radius
    return [Surface(vertices + np.array((0, radius, 0)), faces, palette["rubber"], uv, normals, name="ball: rubber")]


def sculpture(palette: Palette, rng: Random, height: float = 0.4) -> list[Surface]:
    """Return a smooth lump of clay: a sphere swollen and dented by a few soft random waves, twisted, with a flat
    foot."""
    directions, faces, uv = shapes.sphere(1.0, subdivisions=5)
    swell = np.zeros(len(directions))
    for _ in range(7):
        wave, phase = rng.normal(0, 1.7, 3), rng.uniform(0, 2 * np.pi)
        swell += 0.13 * np.sin(directions @ wave + phase)
    points = directions * (1 + swell)[:, None] * (0.62, 1.0, 0.62)
    twist = rng.choice((-1, 1)) * rng.uniform(0.5, 1.1) * points[:, 1]
    c, s = np.cos(twist), np.sin(twist)
    points = np.column_stack((c * points[:, 0] + s * points[:, 2], points[:, 1], c * points[:, 2] - s * points[:, 0]))
    low, high = points[:, 1].min(), points[:, 1].max()
    foot = low + 0.12 * (high - low)
    points[:, 1] = np.maximum(points[:, 1], foot)
    points = (points - (0, foot, 0)) * (height / (high - foot))
    points[:, ::2] -= points[points[:, 1] <= 0][:, ::2].mean(axis=0)
    normals = smooth_normals(points, directions, faces)
    return [Surface(points, faces, palette["clay"], uv, normals, name="sculpture: clay")]


def _palette(colours: Random, textures: Random) -> Palette:
    """Mix the materials of one seed by name. Albedos span 0.05 (leather, dark covers) to 0.9 (ceiling)."""

    def plain(low: float, high: float) -> MaterialFields:
        return {"albedo": float(colours.uniform(low, high))}

    def printed(image: np.ndarray) -> MaterialFields:
        return {"albedo": Texture(image, "made from the seed")}

    gloss: MaterialFields = {"kind": "roughplastic", "ior": 1.5}
    wood = float(colours.uniform(0.25, 0.42))
    made: dict[str, MaterialFields] = {
        "oak planks": printed(planks(textures, wood)),
        "plaster": printed(mottled(textures, colours.uniform(0.55, 0.72), 0.03, 6)),
        "ceiling paint": {"albedo": 0.9},
        "varnished wood": printed(grain(textures, 0.8 * wood)) | gloss | {"roughness": 0.2},
        "wood": plain(0.15, 0.35),
        "white paint": plain(0.75, 0.85),
        "sofa cloth": printed(mottled(textures, colours.uniform(0.25, 0.5), 0.05, 2)),
        "cushion cloth": plain(0.3, 0.65),
        "rug wool": printed(rug_pattern(textures)),
        "painting": printed(landscape(textures)),
        "brushed steel": {"kind": "roughconductor", "roughness": 0.3, "eta": 2.9, "k": 3.1},
        "lamp cloth": plain(0.65, 0.8),
        "rubber": plain(0.3, 0.7) | gloss | {"roughness": 0.3},
        "clay": plain(0.4, 0.75),
        "leather": plain(0.05, 0.12),
    }
    made |= {f"book cover {a:g}": {"albedo": a} for a in (0.06, 0.12, 0.22, 0.35, 0.5, 0.7)}
    return {name: Material(**values, name=name) for name, values in made.items()}
