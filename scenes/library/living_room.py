"""The default demo scene: a furnished living room made from a seed, no files needed.

The room lies around the origin with the floor at y = 0; the camera looks along -z, turned left towards the
far corner. Each piece of furniture is built around its own origin, standing on y = 0 with its front towards +z (as
in `things.basic_furniture`); `placed` turns it and sets it down. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral

import numpy as np

from scenes.errors import InputError
from scenes.geometry import shapes
from scenes.library.things.basic_furniture import RUG_M, bookshelf, chair, floor_lamp, picture, rug, sofa, table
from scenes.library.things.palette import WINDOW_RADIANCE
from scenes.library.things.parts import Palette, Random, box, joined, panel, placed, smooth_normals
from scenes.library.things.patterns import grain, landscape, mottled, planks, rug_pattern
from scenes.material_fields import MaterialFields
from scenes.model import Camera, Material, Scene, Surface, Texture

LOW, HIGH = np.array((-2.05, 0.0, -3.2)), np.array((1.85, 2.5, 3.0))  # the room's corners
TILE_M = 2.0  # edge of the square that one floor or wall texture covers


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
