"""A stairwell that is varnished throughout: the gloss of artists' interiors, which nearly diffuse rooms do not show.

The hall lies around the origin with the floor at y = 0; the camera stands at its near end and looks along -z, past a
flight of stairs on the right. Coats and metals have alpha 0.05 to 0.3, and only ceiling and upper walls are dull.
Every body is closed. Lengths are metres.
"""

from __future__ import annotations

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.parts import (
    Palette,
    box,
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
from scenes.library.things.patterns import grain, landscape, planks, tiles
from scenes.material_fields import MaterialFields
from scenes.model import Camera, Material, Scene, Surface, Texture

LOW, HIGH = np.array((-1.4, 0.0, -3.6)), np.array((1.4, 2.9, 2.6))  # the hall's corners
PANELLED_M = 1.1  # height of the wainscot
TILED_Z = -0.7  # tiles lie on the near side, boards on the far one
STEPS, RISE_M, RUN_M, STAIR_X = 9, 0.175, 0.27, 0.35  # the stairs' left side is at STAIR_X
FIRST_STEP_Z = -0.3
EYE_M, TARGET_M, FOV_DEG = (-0.35, 1.55, 2.3), (0.15, 0.95, -2.0), 60.0
LAMP_RADIANCE = 0.4  # 800 lm from a ball of 28 mm radius, as in `washroom`
SEED = 30  # of the textures


def hall(*, width: int, height: int) -> Scene:
    """Make a closed hall of 2.8 x 6.2 x 2.9 m in which nine of ten surfaces are glossy; the same bytes every time."""
    palette = _palette()
    surfaces = [*_shell(palette), *_stairs(palette), *_railing(palette)]
    surfaces += placed(_door(palette), -0.45, LOW[2])
    surfaces += placed(_cupboard(palette), LOW[0], -2.6, turn_deg=90)
    surfaces += placed(_console(palette), LOW[0], -0.9, turn_deg=90)
    surfaces += placed(_picture(palette), LOW[0], -0.9, y=1.35, turn_deg=90)
    surfaces += placed(_stand(palette), 0.1, -2.9)
    surfaces += placed(_lamp(palette), 0.0, -0.6)
    camera = Camera.look_at(EYE_M, TARGET_M, fov_deg=FOV_DEG, width=width, height=height)
    return Scene("hall", tuple(with_normals(surfaces)), camera)


def _palette() -> Palette:
    draw = np.random.default_rng(SEED)

    def printed(image: np.ndarray) -> Texture:
        return Texture(image, "made from a seed")

    def coat(albedo: float | Texture, alpha: float) -> MaterialFields:
        return {"kind": "roughplastic", "ior": 1.5, "albedo": albedo, "roughness": alpha}

    made: dict[str, MaterialFields] = {
        "boards": coat(printed(planks(draw, 0.3)), 0.1),
        "tiles": coat(printed(tiles(draw, 0.45, 256, 6)), 0.08),
        "steps": coat(printed(grain(draw, 0.32)), 0.12),
        "white lacquer": coat(0.8, 0.2),
        "dark lacquer": coat(0.08, 0.05),
        "varnish": coat(printed(grain(draw, 0.25)), 0.15),
        "picture": coat(printed(landscape(draw)), 0.1),
        "china": coat(0.75, 0.05),
        "satin": coat(0.6, 0.3),
        "rail": {"kind": "roughconductor", "roughness": 0.1, "eta": 2.9, "k": 3.1},
        "brushed": {"kind": "roughconductor", "roughness": 0.2, "eta": 2.9, "k": 3.1},
        "wall paint": {"albedo": 0.65},
        "ceiling paint": {"albedo": 0.85},
        "glow": {"albedo": 0.5},
    }
    return {name: Material(**values, name=name) for name, values in made.items()}


def _shell(palette: Palette) -> list[Surface]:
    """Floor of tiles and boards, ceiling, walls lacquered up to the wainscot's height, and skirting boards."""
    x, _, z = np.diag((HIGH - LOW) / 2)
    centre = (LOW + HIGH) / 2
    near, far = (HIGH[2] - TILED_Z) / 2, (TILED_Z - LOW[2]) / 2
    floors = (("tiles", TILED_Z + near, near, 1.0), ("boards", TILED_Z - far, far, 1.6))
    surfaces = []
    for name, middle, half, tile_m in floors:
        below, above = ((centre[0], level, middle) for level in (LOW[1], HIGH[1]))
        surfaces.append(joined(f"floor: {name}", palette[name], panel(below, x, (0, 0, -half), tile_m)))
        surfaces.append(joined(f"ceiling: over {name}", palette["ceiling paint"], panel(above, x, (0, 0, half))))
    for name, bottom, top in (("white lacquer", LOW[1], PANELLED_M), ("wall paint", PANELLED_M, HIGH[1])):
        up = np.array((0, (top - bottom) / 2, 0))
        middle = np.array((centre[0], (bottom + top) / 2, centre[2]))
        ends = [panel(middle + out, right, up) for out, right in ((-z, x), (z, -x))]
        sides = [
            panel((side * HIGH[0], middle[1], at), (0, 0, side * half), up)
            for side in (-1, 1)
            for _, at, half, _ in floors
        ]
        surfaces.append(joined(f"walls: {name}", palette[name], *ends, *sides))
    return [*surfaces, _skirting(palette)]


def _skirting(palette: Palette) -> Surface:
    """Boards along the walls where nothing is built in."""
    tall, thick = 0.1, 0.018
    boards = [
        box((LOW[0], 0, LOW[2] + thick), (LOW[0] + thick, tall, HIGH[2] - thick)),
        box((HIGH[0] - thick, 0, FIRST_STEP_Z + 0.05), (HIGH[0], tall, HIGH[2] - thick)),
        box((LOW[0], 0, HIGH[2] - thick), (HIGH[0], tall, HIGH[2])),
    ]
    return joined("skirting", palette["white lacquer"], *boards)


def _stairs(palette: Palette) -> list[Surface]:
    """Build steps along the right wall that rise away from the camera: treads on risers, and a string beside them."""
    treads, risers, strings = [], [], []
    for step in range(STEPS):
        top, front = (step + 1) * RISE_M, FIRST_STEP_Z - step * RUN_M
        treads.append(box((STAIR_X - 0.02, top - 0.03, front - RUN_M), (HIGH[0], top, front + 0.03)))
        risers.append(box((STAIR_X, 0.0, front - RUN_M), (HIGH[0], top - 0.03, front)))
        strings.append(box((STAIR_X - 0.025, 0.0, front - RUN_M), (STAIR_X, top - 0.06, front)))
    return [
        joined("stairs: treads", palette["steps"], *treads),
        joined("stairs: risers", palette["white lacquer"], *risers),
        joined("stairs: string", palette["varnish"], *strings),
    ]


def _railing(palette: Palette) -> list[Surface]:
    """Two posts, a round handrail and upright bars of metal on the open side of the stairs."""
    x, tall, bars = STAIR_X + 0.04, 0.9, []
    slope = RISE_M / RUN_M

    def step_top(z: float) -> float:
        return (int((FIRST_STEP_Z - z) // RUN_M) + 1) * RISE_M

    def hand(z: float) -> float:
        return tall + RISE_M + slope * (FIRST_STEP_Z - z)

    last = FIRST_STEP_Z - STEPS * RUN_M
    for z in np.arange(FIRST_STEP_Z - 0.2, last + 0.1, -0.135):
        bars.append(rod(np.array(((x, step_top(z) - 0.002, z), (x, hand(z), z))), 0.007))
    line = np.array(((x, hand(FIRST_STEP_Z - 0.06), FIRST_STEP_Z - 0.06), (x, hand(last), last + 0.03)))
    ends = [post(x, FIRST_STEP_Z - 0.06, 0.035, RISE_M, hand(FIRST_STEP_Z) + 0.08)]
    knob = moved(shapes.sphere(0.045, 3), (x, hand(FIRST_STEP_Z) + 0.12, FIRST_STEP_Z - 0.06))
    return [
        joined("railing: handrail", palette["rail"], rod(line, 0.022, 24), knob),
        joined("railing: bars", palette["brushed"], *bars),
        joined("railing: post", palette["varnish"], *ends),
    ]


def _door(palette: Palette) -> list[Surface]:
    """Build a lacquered door with two raised fields, in its frame, with a metal handle; its back at z = 0."""
    half, tall = 0.42, 2.05
    frame = [box((s - 0.045, 0, 0), (s + 0.045, tall, 0.06)) for s in (-half - 0.045, half + 0.045)]
    frame.append(box((-half - 0.09, tall, 0), (half + 0.09, tall + 0.09, 0.06)))
    leaf = [box((-half, 0.005, 0), (half, tall, 0.03))]
    leaf += [box((-half + 0.12, low, 0.03), (half - 0.12, high, 0.042)) for low, high in ((0.2, 0.9), (1.1, 1.9))]
    grip = np.array(((half - 0.06, 1.02, 0.02), (half - 0.06, 1.02, 0.075), (half - 0.19, 1.02, 0.075)))
    rose = turned(
        solid([(0.0, 0.0), (0.025, 0.0), (0.022, 0.008), (0.0, 0.008)], 24), "x", 90, (half - 0.06, 1.02, 0.03)
    )
    return [
        joined("door: frame", palette["white lacquer"], *frame),
        joined("door: leaf", palette["satin"], *leaf),
        joined("door: handle", palette["rail"], rod(grip, 0.009, 16), rose),
    ]


def _cupboard(palette: Palette) -> list[Surface]:
    """Build a tall dark lacquered cupboard with two doors and bar handles; its back at z = 0."""
    wide, tall, deep = 1.0, 1.85, 0.42
    body = box((-wide / 2, 0.06, 0.0), (wide / 2, tall, deep))
    base = box((-wide / 2 + 0.03, 0.0, 0.02), (wide / 2 - 0.03, 0.06, deep - 0.04))
    doors = [box((a, 0.09, deep), (a + wide / 2 - 0.015, tall - 0.03, deep + 0.018)) for a in (-wide / 2 + 0.01, 0.005)]
    front = deep + 0.018
    bars = [
        rod(
            np.array(
                ((x, 0.85, front - 0.005), (x, 0.85, front + 0.03), (x, 1.2, front + 0.03), (x, 1.2, front - 0.005))
            ),
            0.006,
        )
        for x in (-0.045, 0.05)
    ]
    return [
        joined("cupboard: case", palette["dark lacquer"], body, base, *doors),
        joined("cupboard: handles", palette["brushed"], *bars),
    ]


def _console(palette: Palette) -> list[Surface]:
    """Build a varnished table along the wall with a china vase, a bowl of metal and two lacquered boxes on it."""
    wide, tall, deep = 1.1, 0.8, 0.32
    top = box((-wide / 2, tall - 0.03, 0), (wide / 2, tall, deep))
    legs = [post(x, z, 0.02, 0, tall - 0.03) for x in (0.05 - wide / 2, wide / 2 - 0.05) for z in (0.04, deep - 0.04)]
    t = np.linspace(0, 1, 15)
    radii = 0.045 + 0.035 * np.sin(np.pi * t**0.8) - 0.02 * t
    outside = [(float(r), 0.28 * float(s)) for r, s in zip(radii, t, strict=True)]
    inside = [(0.9 * r, max(y, 0.01)) for r, y in outside[::-1]]
    vase = moved(solid([(0.0, 0.0), *outside, *inside, (0.0, 0.01)], 40), (0.3, tall, 0.16))
    bowl = [(0.03, 0.0), (0.09, 0.03), (0.12, 0.07), (0.114, 0.07), (0.085, 0.034), (0.028, 0.006)]
    dish = moved(solid([(0.0, 0.0), *bowl, (0.0, 0.006)], 40), (-0.02, tall, 0.16))
    boxes = [turned(box((-0.09, 0, -0.06), (0.09, 0.07, 0.06)), "y", 14, (-0.34, tall, 0.16))]
    boxes.append(turned(box((-0.06, 0, -0.045), (0.06, 0.05, 0.045)), "y", -9, (-0.34, tall + 0.0705, 0.16)))
    return [
        joined("console: wood", palette["varnish"], top, *legs),
        joined("console: vase", palette["china"], vase),
        joined("console: dish", palette["brushed"], dish),
        joined("console: boxes", palette["dark lacquer"], *boxes),
    ]


def _picture(palette: Palette) -> list[Surface]:
    """Build a varnished painting in a frame; its back at z = 0 and its lower edge at y = 0."""
    x, tall, bar = 0.45, 0.62, 0.04
    frame = [box((-x, y, 0), (x, y + bar, 0.03)) for y in (0.0, tall - bar)]
    frame += [box((left, bar, 0), (left + bar, tall - bar, 0.03)) for left in (-x, x - bar)]
    canvas = box((bar - x, bar, 0), (x - bar, tall - bar, 0.015))
    return [joined("picture: frame", palette["varnish"], *frame), joined("picture: canvas", palette["picture"], canvas)]


def _stand(palette: Palette) -> list[Surface]:
    """Build a metal stand for umbrellas, and two of these in it."""
    body = [(0.0, 0.0), (0.11, 0.0), (0.11, 0.5), (0.105, 0.5), (0.105, 0.01), (0.0, 0.01)]
    sticks = [rod(np.array(((0.03 * s, 0.012, 0.02), (0.07 * s, 0.85, -0.05 * s))), 0.016) for s in (-1, 1)]
    return [
        joined("stand: metal", palette["brushed"], solid(body, 40)),
        joined("stand: umbrellas", palette["dark lacquer"], *sticks),
    ]


def _lamp(palette: Palette) -> list[Surface]:
    """Build a glowing ball under a lacquered shade that hangs from the ceiling."""
    y = HIGH[1] - 0.45
    rim = [(0.18, y), (0.15, y + 0.08), (0.05, y + 0.14), (0.012, y + 0.15)]
    inner = [(0.008, y + 0.146), (0.046, y + 0.136), (0.146, y + 0.076), (0.174, y)]
    shade = solid([*rim, *inner, rim[0]], 40)
    return [
        joined("lamp: shade", palette["white lacquer"], shade),
        joined("lamp: wire", palette["dark lacquer"], rod(np.array(((0, y + 0.1, 0), (0, HIGH[1], 0))), 0.005)),
        joined("lamp: glow", palette["glow"], moved(shapes.sphere(0.028, 3), (0, y + 0.04, 0)), emission=LAMP_RADIANCE),
    ]
