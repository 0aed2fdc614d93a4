"""A washroom that is hard for renderers: chrome, a mirror, lamps in glass bulbs, a glass door, glossy tiles.

Light of the lamps gets out through glass alone: a thin bulb lets it pass straight, a thick one bends it. What the laser
shines on throws it on: taps, pipes and rails of chrome. The room lies around the origin with the floor at y = 0; the
camera looks along -z at a basin below a mirror. Every body is closed; the glass door is a single sheet. Lengths are
metres.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.parts import (
    Palette,
    box,
    cloth,
    joined,
    moved,
    panel,
    placed,
    post,
    rod,
    solid,
    turned,
    with_normals,
)
from scenes.library.things.patterns import tiles
from scenes.model import Camera, Material, Scene, Surface, Texture

LOW, HIGH = np.array((-1.3, 0.0, -1.7)), np.array((1.3, 2.5, 1.7))  # the room's corners
TILED_M = 1.5  # height of the tiles on the walls
TILE_M = 1.2  # edge of the square that one texture of tiles covers
BASIN_X, RIM_Y = -0.45, 0.86
BULB_M, GLASS_M = 0.05, 0.003  # radius of a bulb, thickness of thick glass
EMITTER_M = 0.012  # radius of what glows inside
EYE_M, TARGET_M, FOV_DEG = (0.35, 1.5, 1.45), (-0.12, 1.05, -1.7), 68.0
# 800 lm leave a ball of 12 mm radius evenly: 800 / (4 pi r^2 pi) = 1.4e5 cd/m^2; as in `living_room` 1e5 lx are
# 1.5 W/(m^2 nm), so that the lamps have 1.4e5 x 1.5e-5.
LAMP_RADIANCE = 2.1
SEED = 29  # of the tiles' shades
SHEETS = ("door: glass",)  # single sheets, with edges of their own


def washroom(*, width: int, height: int) -> Scene:
    """Make a closed room of 2.6 x 3.4 x 2.5 m whose laser light is half that of metal, glass and glaze.

    Chrome is polished (the pipes are perfect mirrors, the taps have alpha 0.02), tiles and glaze are coated plastic of
    alpha 0.05 to 0.1. The same bytes every time.
    """
    palette = _palette()
    surfaces = [*_shell(palette), *_door(palette), *_shower(palette), *_towel_rail(palette), *_stool(palette)]
    surfaces += placed(_basin(palette), BASIN_X, LOW[2])
    surfaces += placed(_mirror(palette), BASIN_X, LOW[2])
    for side, glass in ((-0.52, "thin glass"), (0.52, "thick glass")):
        surfaces += placed(_bulb(palette, glass), BASIN_X + side, LOW[2] + 0.16, y=1.62)
    camera = Camera.look_at(EYE_M, TARGET_M, fov_deg=FOV_DEG, width=width, height=height)
    return Scene("washroom", tuple(with_normals(surfaces)), camera)


def _palette() -> Palette:
    draw = np.random.default_rng(SEED)
    shades = Texture(tiles(draw, 0.72, 256, 8), "made from a seed")
    ground = Texture(tiles(draw, 0.35, 256, 4), "made from a seed")
    gloss = {"kind": "roughplastic", "ior": 1.5}
    chrome = {"eta": 3.1, "k": 3.3}
    made: dict[str, dict[str, Any]] = {
        "wall tiles": {"albedo": shades, "roughness": 0.05} | gloss,
        "floor tiles": {"albedo": ground, "roughness": 0.1} | gloss,
        "paint": {"albedo": 0.75},
        "glaze": {"albedo": 0.8, "roughness": 0.05} | gloss,
        "chrome": {"kind": "roughconductor", "roughness": 0.02} | chrome,
        "pipe chrome": {"kind": "conductor"} | chrome,
        "mirror": {"kind": "conductor", "specular": 0.9},
        "thin glass": {"kind": "thindielectric", "ior": 1.5},
        "thick glass": {"kind": "dielectric", "ior": 1.5},
        "filament": {"albedo": 0.5},
        "towel": {"albedo": 0.45},
        "wood": {"albedo": 0.3, "roughness": 0.2} | gloss,
    }
    return {name: Material(**values, name=name) for name, values in made.items()}


def _shell(palette: Palette) -> list[Surface]:
    """Floor, ceiling and walls, tiled below and painted above, all facing inwards."""
    x, y, z = np.diag((HIGH - LOW) / 2)
    centre = (LOW + HIGH) / 2
    walls = ((-z, x), (z, -x), (-x, -z), (x, z))

    def band(bottom: float, top: float, tile_m: float | None) -> list[shapes.Shape]:
        middle = np.array((centre[0], (bottom + top) / 2, centre[2]))
        return [panel(middle + out, right, (0, (top - bottom) / 2, 0), tile_m) for out, right in walls]

    return [
        joined("floor", palette["floor tiles"], panel(centre - y, x, -z, TILE_M)),
        joined("ceiling", palette["paint"], panel(centre + y, x, z)),
        joined("tiles", palette["wall tiles"], *band(LOW[1], TILED_M, TILE_M)),
        joined("paint", palette["paint"], *band(TILED_M, HIGH[1], None)),
    ]


def _arc(centre: tuple[float, float], radius: float, first_deg: float, last_deg: float, count: int = 13) -> np.ndarray:
    """Points of an arc in the plane x = 0: angles from +z towards +y."""
    angle = np.radians(np.linspace(first_deg, last_deg, count))
    return np.column_stack((0 * angle, centre[0] + radius * np.sin(angle), centre[1] + radius * np.cos(angle)))


def _basin(palette: Palette) -> list[Surface]:
    """Build a glazed bowl on the wall, a tap with two handles on its rim, a trap and two pipes below it."""
    depth, radius = 0.17, 0.25
    t = np.linspace(0, np.pi / 2, 11)
    outside = [(radius * math.sin(a), RIM_Y - depth * math.cos(a)) for a in t]
    inside = [(0.92 * radius * math.sin(a), RIM_Y - 0.9 * depth * math.cos(a)) for a in t[::-1]]
    bowl = moved(solid([*outside, *inside], 48), (0, 0, 0.3))
    ledge = box((-0.2, RIM_Y - 0.09, 0.0), (0.2, RIM_Y - 0.005, 0.1))
    body = solid([(0.0, 0.0), (0.026, 0.0), (0.02, 0.015), (0.017, 0.09), (0.012, 0.1), (0.0, 0.1)], 32)
    body = moved(body, (0, RIM_Y - 0.005, 0.05))
    neck = np.concatenate(([(0, RIM_Y + 0.08, 0.05)], _arc((RIM_Y + 0.12, 0.11), 0.06, 180, 0)))
    spout = rod(np.concatenate((neck, [(0, RIM_Y + 0.09, 0.17)])), 0.011, 24)
    handles = [
        turned(solid([(0.0, 0.0), (0.008, 0.0), (0.008, 0.03), (0.019, 0.04), (0.016, 0.075), (0.0, 0.08)], 24), "z", a)
        for a in (55, -55)
    ]
    handles = [moved(part, (x, RIM_Y + 0.03, 0.05)) for part, x in zip(handles, (-0.014, 0.014), strict=True)]
    trap = np.concatenate(
        (
            [(0, RIM_Y - 0.15, 0.3)],
            _arc((0.58, 0.25), 0.05, 0, -180),
            [(0, 0.62, 0.2)],
            _arc((0.62, 0.15), 0.05, 0, 90)[1:],
            [(0, 0.67, -0.005)],
        )
    )
    supply = [rod(np.array(((x, 0.45, -0.005), (x, 0.45, 0.05), (x, RIM_Y - 0.1, 0.05))), 0.007) for x in (-0.12, 0.12)]
    return [
        joined("basin: bowl", palette["glaze"], bowl, ledge),
        joined("basin: tap", palette["chrome"], body, spout, *handles),
        joined("basin: pipes", palette["pipe chrome"], rod(trap, 0.02, 24), *supply),
    ]


def _mirror(palette: Palette) -> list[Surface]:
    """Build a silvered plate in a chrome frame, its back on the wall."""
    x, low, high = 0.38, 1.15, 1.95
    frame = [box((s - 0.012, low, 0), (s + 0.012, high, 0.02)) for s in (-x - 0.012, x + 0.012)]
    frame += [box((-x - 0.024, y, 0), (x + 0.024, y + 0.024, 0.02)) for y in (low - 0.024, high)]
    plate = box((-x, low, 0), (x, high, 0.01))
    return [joined("mirror: plate", palette["mirror"], plate), joined("mirror: frame", palette["chrome"], *frame)]


def _bulb(palette: Palette, glass: str) -> list[Surface]:
    """Build a glowing ball in a bulb of glass, on an arm of chrome that leads back to the wall at z = -0.16."""
    outer, faces, uv = shapes.sphere(BULB_M, 4)
    shells = [(outer, faces, uv)]
    if palette[glass].kind == "dielectric":  # its hollow: air inside glass, so its faces look inwards
        inner, _, _ = shapes.sphere(BULB_M - GLASS_M, 4)
        shells.append((inner, faces[:, ::-1], uv))
    glow = shapes.sphere(EMITTER_M, 3)
    cup = solid([(0.0, -0.085), (0.022, -0.085), (0.03, -0.06), (0.03, -0.054), (0.0, -0.054)], 32)
    arm = rod(np.array(((0, -0.08, 0.0), (0, -0.12, -0.05), (0, -0.12, -0.165))), 0.008, 16)
    plate = turned(solid([(0.0, 0.0), (0.045, 0.0), (0.04, 0.012), (0.0, 0.012)], 32), "x", 90, (0, -0.12, -0.16))
    name = f"lamp in {glass}"
    return [
        joined(f"{name}: bulb", palette[glass], *shells),
        joined(f"{name}: glow", palette["filament"], glow, emission=LAMP_RADIANCE),
        joined(f"{name}: arm", palette["chrome"], cup, arm, plate),
    ]


def _door(palette: Palette) -> list[Surface]:
    """Build a shower's glass door across the right half of the room, framed in chrome, with a handle through it."""
    left, z, top = 0.38, -0.55, 2.0
    middle, half = (left + HIGH[0]) / 2, (HIGH[0] - left) / 2 - 0.02
    posts = [post(x, z, 0.015, 0.0, top) for x in (left + 0.005, HIGH[0] - 0.015)]
    rails = [box((left + 0.02, y, z - 0.015), (HIGH[0] - 0.03, y + 0.03, z + 0.015)) for y in (0.0, top - 0.03)]
    grip = np.array(((0.5, 0.95, 0.0), (0.5, 0.95, 0.05), (0.5, 1.25, 0.05), (0.5, 1.25, 0.0))) + (0, 0, z)
    pane = panel((middle, top / 2, z), (half, 0, 0), (0, top / 2 - 0.03, 0))
    return [
        joined("door: glass", palette["thin glass"], pane),
        joined("door: frame", palette["chrome"], *posts, *rails, rod(grip, 0.009, 16)),
    ]


def _shower(palette: Palette) -> list[Surface]:
    """Build an upright pipe with a head that looks down, and a mixer, on the far wall behind the glass."""
    x, z = 0.85, LOW[2]
    bend = _arc((1.98, z + 0.16), 0.1, 180, 90) + (x, 0, 0)
    line = np.concatenate(([(x, 0.95, z + 0.06)], bend, [(x, 2.08, z + 0.34)]))
    head = solid([(0.0, 0.0), (0.09, 0.0), (0.085, 0.015), (0.02, 0.03), (0.012, 0.05), (0.0, 0.05)], 40)
    head = moved(head, (x, 2.02, z + 0.34))
    mixer = turned(shapes.cylinder((0, -0.09, 0), (0, 0.09, 0), 0.025, segments=32, caps=True), "z", 90, (x, 0.95, 0))
    lever = turned(solid([(0.0, 0.0), (0.007, 0.0), (0.012, 0.1), (0.0, 0.11)], 20), "x", 60, (x, 0.97, z + 0.07))
    return [
        joined("shower: pipe", palette["pipe chrome"], rod(line, 0.012, 20)),
        joined("shower: fittings", palette["chrome"], head, moved(mixer, (0, 0, z + 0.06)), lever),
    ]


def _towel_rail(palette: Palette) -> list[Surface]:
    """Build a ladder of pipes on the left wall, and a towel over one of its rungs."""
    x, near, far = LOW[0] + 0.07, -0.05, -0.6
    rails = [rod(np.array(((x, 0.45, z), (x, 1.45, z))), 0.014, 20) for z in (near, far)]
    rungs = [rod(np.array(((x, y, near), (x, y, far))), 0.009, 16) for y in np.linspace(0.5, 1.4, 9)]
    stays = [rod(np.array(((x, y, z), (LOW[0] - 0.005, y, z))), 0.008, 12) for y in (0.55, 1.35) for z in (near, far)]
    # over the rung at 1.2875 m: down the front, round the pipe, down the back, in soft folds
    turn = np.linspace(0, np.pi, 9)
    front = np.column_stack((np.full(9, 0.016), np.linspace(0.72, 1.28, 9)))
    over = np.column_stack((0.016 * np.cos(turn), 1.2875 + 0.016 * np.sin(turn)))
    back = np.column_stack((np.full(5, -0.016), np.linspace(1.27, 0.98, 5)))
    line = np.concatenate((front, over, back))
    z = np.linspace(near - 0.08, far + 0.08, 25)
    drop = np.clip((1.25 - line[:, 1]) / 0.5, 0, 1)
    folds = 0.012 * drop[:, None] * np.sin(60 * z) * np.sign(line[:, :1] + 1e-12)
    points = np.stack((x + line[:, :1] + folds, line[:, 1:] + 0 * z, 0 * line[:, :1] + z), axis=-1)
    across = np.zeros_like(points)
    across[..., 0], across[..., 1] = -np.gradient(line[:, 1])[:, None], np.gradient(line[:, 0])[:, None]
    across *= 0.005 / np.linalg.norm(across, axis=-1, keepdims=True)
    return [
        joined("rail: pipes", palette["pipe chrome"], *rails, *rungs, *stays),
        joined("rail: towel", palette["towel"], cloth(points, across)),
    ]


def _stool(palette: Palette) -> list[Surface]:
    """Build a round stool before the door, with a folded towel on it."""
    seat = solid([(0.0, 0.41), (0.16, 0.41), (0.165, 0.43), (0.16, 0.45), (0.0, 0.45)], 40)
    legs = [
        rod(np.array(((0.13 * c, 0.42, 0.13 * s), (0.17 * c, 0.0, 0.17 * s))), 0.014)
        for c, s in ((math.cos(a), math.sin(a)) for a in np.radians((30, 150, 270)))
    ]
    folded = [turned(box((-0.11, y, -0.08), (0.11, y + 0.045, 0.08)), "y", a) for y, a in ((0.451, 8), (0.497, 3))]
    surfaces = [joined("stool: wood", palette["wood"], seat, *legs), joined("stool: towels", palette["towel"], *folded)]
    return placed(surfaces, 0.12, -0.75)
