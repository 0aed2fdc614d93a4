"""Edge-rich views for training depth networks: many overlapping thin, ragged and bent things in a closed room.

Rooms are smooth: few of their pixels lie at depth edges. Here most do. Each view has a room, a camera and 3 to 40
`edge_shapes` of its own, at 0.3 to 13.5 m, textured, lit by a window or a lamp as ambient light.
Nothing in it was fitted to any test image.
"""

from __future__ import annotations

import math

import numpy as np

from scenes.library.rooms import one_of_each
from scenes.library.things.edge_shapes import MAKERS, random_rotation, rotated
from scenes.library.things.palette import LAMP_RADIANCE, WINDOW_RADIANCE, make_palette, pick
from scenes.library.things.parts import Palette, Random, joined, panel, with_normals
from scenes.library.things.patterns import on_one_sheet
from scenes.model import Camera, Material, Scene, Surface
from scenes.random_streams import Stream

SPLITS = ("train", "val", "test")
FOV_DEG = (36.0, 66.0)
BACK_M = (1.3, 13.0)  # camera to the wall that it faces
TOWARDS_NEAR = 1.5  # exponent of a uniform number, then between the logarithms of BACK_M: median 2.9 m
NEAREST_M = 0.3
NEAR_FRACTION = (0.18, 0.6)  # nearest thing over the back wall's distance
RARELY_NEAR, RARE_FRACTION = 0.1, (0.06, 0.18)  # in a tenth of the views
COUNT = (5, 40)
ANGLE_DEG = (3.0, 30.0)  # half the angle that a thing takes
CLEAR_M = 0.02  # between a thing and a wall
TEXTURES = ("painting", "print", "pattern", "wood", "cloth", "rug", "floor")


def clutter_view(index: int, split: str = "train", *, seed: int = 0, width: int = 64, height: int = 64) -> Scene:
    """Build view `index` of a split; equal arguments give equal scenes, byte for byte.

    Splits draw from streams of their own, and so does every view.
    """
    key = (Stream.CLUTTER, SPLITS.index(split), index)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    palette = make_palette(rng)
    camera, low, high = _room(rng, width, height)
    surfaces = [
        *_shell(palette, low, high),
        *_lights(palette, rng, low, high),
        *_things(palette, rng, camera, low, high),
    ]
    surfaces += one_of_each(palette, low[1] - 0.5)
    brightness = float(rng.uniform(0.2, 2.0))
    notes = (f"procedural, {split} view {index} of seed {seed}",)
    return Scene(
        f"clutter/{split}/{index}", tuple(with_normals(on_one_sheet(surfaces), brightness)), camera, notes=notes
    )


def _room(rng: Random, width: int, height: int) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Draw a box-shaped room around a camera at the origin that faces one of its walls, often at an angle."""
    back = BACK_M[0] * (BACK_M[1] / BACK_M[0]) ** (rng.random() ** TOWARDS_NEAR)
    fov = rng.uniform(*FOV_DEG)
    reach = back * math.tan(math.radians(fov / 2))
    low = np.array((-rng.uniform(0.5, 1.3) * reach - 0.4, -rng.uniform(0.5, 1.3) * reach - 0.3, -back))
    high = np.array((rng.uniform(0.5, 1.3) * reach + 0.4, rng.uniform(0.5, 1.3) * reach + 0.3, rng.uniform(0.5, 2.5)))
    yaw, pitch = math.radians(rng.normal(0, 16)), math.radians(rng.normal(0, 9))
    ahead = np.array((math.sin(yaw) * math.cos(pitch), math.sin(pitch), -math.cos(yaw) * math.cos(pitch)))
    up = (rng.normal(0, 0.05), 1.0, 0.0)
    camera = Camera.look_at((0, 0, 0), ahead, fov_deg=fov, width=width, height=height, up=up)
    return camera, low, high


def _shell(palette: Palette, low: np.ndarray, high: np.ndarray) -> list[Surface]:
    """Build the six sides of the room, seen from inside."""
    middle, half = (low + high) / 2, (high - low) / 2
    x, y, z = np.diag(half)
    sides = [
        panel(middle - z, x, y), panel(middle + z, -x, y), panel(middle - x, -z, y), panel(middle + x, z, y)
    ]  # fmt: skip
    return [
        joined("walls", palette["wall"], *sides),
        joined("floor", palette["floor"], panel(middle - y, x, -z)),
        joined("ceiling", palette["ceiling paint"], panel(middle + y, x, z)),
    ]


def _lights(palette: Palette, rng: Random, low: np.ndarray, high: np.ndarray) -> list[Surface]:
    """Place a window in the wall behind the camera or a side wall, and often a lamp under the ceiling."""
    middle, half = (low + high) / 2, (high - low) / 2
    side = rng.choice((-1, 1))
    wide, tall = rng.uniform(0.15, 0.5, 2) * (half[2], half[1])
    at = np.array((middle[0] + side * (half[0] - 0.01), middle[1] + rng.uniform(-0.3, 0.3) * half[1], middle[2]))
    at[2] += rng.uniform(-0.5, 0.5) * half[2]
    window = panel(at, (0, 0, side * wide), (0, tall, 0))
    surfaces = [joined("window: sky", palette["sky"], window, emission=WINDOW_RADIANCE)]
    if rng.random() < 0.6:
        size = rng.uniform(0.05, 0.2) * min(half[0], half[2])
        at = np.array((rng.uniform(low[0], high[0]) * 0.7, high[1] - 0.01, rng.uniform(low[2], high[2]) * 0.7))
        lamp = panel(at, (size, 0, 0), (0, 0, size))
        surfaces.append(joined("lamp: cloth", palette["lamp cloth"], lamp, emission=LAMP_RADIANCE))
    return surfaces


def _things(palette: Palette, rng: Random, camera: Camera, low: np.ndarray, high: np.ndarray) -> list[Surface]:
    """Scatter things over the view, from the nearest distance to the wall, evenly in the logarithm of distance."""
    back = -low[2]
    fraction = RARE_FRACTION if rng.random() < RARELY_NEAR else NEAR_FRACTION
    nearest = max(NEAREST_M, back * math.exp(rng.uniform(*np.log(fraction))))
    tangent = math.tan(math.radians(camera.fov_deg / 2))
    surfaces = []
    for _ in range(round(math.exp(rng.uniform(*np.log(COUNT))))):
        maker = MAKERS[int(rng.integers(len(MAKERS)))]
        shape = rotated(maker(rng), random_rotation(rng))
        distance = math.exp(rng.uniform(math.log(nearest), math.log(max(back, 1.05 * nearest))))
        ray = np.array((*(rng.uniform(-1.05, 1.05, 2) * tangent), 1.0))
        ray = camera.rotation @ (ray / np.linalg.norm(ray))
        radius = distance * math.tan(math.radians(math.exp(rng.uniform(*np.log(ANGLE_DEG)))))
        # the whole thing, which fills a ball of that radius, stays behind the nearest distance
        centre = ray * max(distance, nearest + radius)
        vertices = shape[0] * (radius / np.linalg.norm(shape[0], axis=1).max()) + centre
        # what would stick through a wall is broken off
        inside = ((vertices > low + CLEAR_M) & (vertices < high - CLEAR_M)).all(axis=1)
        faces = shape[1][inside[shape[1]].all(axis=1)]
        material = _paint(palette, rng)
        if len(faces):
            surfaces.append(joined(f"{maker.__name__}: thing", material, (vertices, faces, shape[2])))
    return surfaces


def _paint(palette: Palette, rng: Random) -> Material:
    """Draw a material: mostly textured or plain matte, some varnished or metal."""
    kind = rng.random()
    if kind < 0.55:
        textured = [name for name in palette if name.startswith(TEXTURES) and hasattr(palette[name].albedo, "image")]
        return palette[textured[int(rng.integers(len(textured)))]]
    if kind < 0.9:
        return pick(palette, rng, str(rng.choice(("cloth", "paint", "dark", "clay", "card", "leaf", "book cover"))))
    return palette["steel"] if kind > 0.98 else pick(palette, rng, "satin" if kind < 0.95 else "gloss")
