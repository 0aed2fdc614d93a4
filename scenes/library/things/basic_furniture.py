"""Build furniture of stated sizes: table, chair, sofa, bookshelf, lamp, picture and rug.

Each stands around its own origin on y = 0 with its front towards +z. Lengths are metres.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.palette import LAMP_RADIANCE
from scenes.library.things.parts import Palette, Random, box, joined, panel, post
from scenes.model import Material, Surface

RUG_M = 0.012  # thickness of the rug


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
