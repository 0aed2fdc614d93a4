"""Textures made from a random stream: paint, cloth, wood, tiles, rugs, pictures, and one sheet that holds them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from scenes.library.things.parts import Random
from scenes.model import Material, Surface, Texture


def soft_noise(rng: Random, shape: tuple[int, int], size_px: tuple[float, float]) -> np.ndarray:
    """Return Gaussian noise of unit variance blurred to blobs of `size_px` (rows, columns); periodic, so that it
    tiles."""
    from scipy import fft  # 0.2 s of CPU, which a list of scenes need not wait for

    rows, columns = (
        np.exp(-2 * np.pi**2 * (frequency * size) ** 2).astype(np.float32)
        for frequency, size in zip((np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1])), size_px, strict=True)
    )
    white = rng.standard_normal(shape, np.float32)
    noise = fft.irfft2(fft.rfft2(white) * rows[:, None] * columns, s=shape)
    return (noise - noise.mean()) / noise.std()


def mottled(rng: Random, mean: float, spread: float, size_px: float, side: int = 256) -> np.ndarray:
    """Return an even paint or cloth with soft spots."""
    return np.clip(mean + spread * soft_noise(rng, (side, side), (size_px, size_px)), 0.05, 0.9)


def grain(rng: Random, mean: float, side: int = 256) -> np.ndarray:
    """Return wood grain along the columns of the image."""
    streaks = soft_noise(rng, (side, side), (40, 1)) + 0.6 * soft_noise(rng, (side, side), (60, 5))
    return np.clip(mean * (1 + 0.16 * streaks), 0.05, 0.9)


def planks(rng: Random, mean: float, side: int = 512, across: int = 14) -> np.ndarray:
    """Return floor boards running up the image: each has its own brightness and joints, dark gaps between them."""
    image = grain(rng, mean, side)
    edges = np.round(np.linspace(0, side, across + 1)).astype(int)
    for left, right in pairwise(edges):
        joint = int(rng.integers(side))
        board = np.roll(image[:, left:right], joint, axis=0)
        half = side // 2 + int(rng.integers(-side // 8, side // 8))
        board[:half] *= rng.uniform(0.75, 1.3)
        board[half:] *= rng.uniform(0.75, 1.3)
        board[[0, half]] *= 0.35
        board[:, 0] *= 0.35
        image[:, left:right] = np.roll(board, -joint, axis=0)
    return np.clip(image, 0.05, 0.9)


def rug_pattern(rng: Random, side: int = 256) -> np.ndarray:
    """Return a border of bands around a field of diamonds, with the nap of wool."""
    centred = np.abs(np.linspace(-1, 1, side))
    rows, columns = centred[:, None], centred[None]
    inset = 1 - np.maximum(rows, columns)
    dark, light = rng.uniform(0.08, 0.2), rng.uniform(0.5, 0.75)
    across, along = np.pi * rng.integers(3, 6, 2)
    waves = np.cos(across * (rows + columns)) + np.cos(along * (rows - columns))
    image = np.where(waves > 0, light, (dark + light) / 2)
    image = np.where(inset < 0.22, np.where(inset % 0.11 < 0.06, dark, light), image)
    return np.clip(image * (1 + 0.08 * soft_noise(rng, (side, side), (1, 1))), 0.05, 0.9)


def landscape(rng: Random, height: int = 192, width: int = 288) -> np.ndarray:
    """Return a painting: a sun in a sky that pales towards the horizon, before it ever darker ranges of hills."""
    y, x = np.linspace(1, 0, height)[:, None], np.linspace(0, 1.5, width)[None]
    image = 0.75 - 0.3 * y + 0 * x
    sun_x, sun_y = rng.uniform(0.3, 1.2), rng.uniform(0.7, 0.85)
    image = np.where(np.hypot(x - sun_x, y - sun_y) < 0.09, 0.9, image)
    for crest, albedo in ((0.58, 0.4), (0.42, 0.22), (0.24, 0.08)):
        ridge = crest + 0.07 * soft_noise(rng, (1, width), (1, 18))
        image = np.where(y < ridge, albedo, image)
    return np.clip(image * (1 + 0.05 * soft_noise(rng, (height, width), (1, 3))), 0.05, 0.9)


def tiles(rng: Random, mean: float, side: int = 256, across: int = 8) -> np.ndarray:
    """Return square floor tiles of slightly different brightness, or a chequerboard, with joints between them."""
    cell = np.arange(side) * across // side
    each = rng.uniform(0.9, 1.1, (across, across))
    if rng.random() < 0.4:
        each = np.where((np.add.outer(np.arange(across), np.arange(across)) % 2) > 0, 1.25, 0.45) * each
    image = mean * each[np.ix_(cell, cell)]
    joint = np.arange(side) * across % side < across
    image[joint] *= 0.6
    image[:, joint] *= 0.6
    return np.clip(image * (1 + 0.04 * soft_noise(rng, (side, side), (3, 3))), 0.03, 0.95)


def stripes(rng: Random, side: int = 128) -> np.ndarray:
    """Return woven stripes or checks of three albedos."""
    colours = rng.uniform(0.05, 0.9, 3)
    bands = np.sort(rng.integers(0, side, 2 * rng.integers(2, 7)))
    row = colours[np.searchsorted(bands, np.arange(side)) % 3]
    image = np.broadcast_to(row, (side, side))
    if rng.random() < 0.5:
        image = (image + image.T) / 2
    return np.clip(image * (1 + 0.06 * soft_noise(rng, (side, side), (1, 1))), 0.03, 0.95)


def print_page(rng: Random, side: int = 128) -> np.ndarray:
    """Return a poster or a screen: blocks of dark or light lines and a few filled shapes on an even ground."""
    ground, ink = (0.85, 0.05) if rng.random() < 0.6 else (0.05, 0.7)
    image = np.full((side, side), ground)
    y = int(rng.integers(4, 20))
    while y < side - 12:
        tall, left, right = rng.integers(2, 26), rng.integers(4, 30), side - rng.integers(4, 60)
        if tall < 8:
            image[y : y + 3, left:right] = ink
        else:
            image[y : y + tall, left:right] = rng.uniform(0.1, 0.8)
        y += int(tall + rng.integers(3, 8))
    return image


def spines(rng: Random, side: int = 128) -> np.ndarray:
    """Return upright book spines with titles."""
    edges = np.unique(np.concatenate(([0], rng.integers(0, side, 14), [side])))
    image = np.empty((side, side))
    for left, right in pairwise(edges):
        image[:, left:right] = rng.uniform(0.05, 0.85)
        top = int(rng.integers(10, side // 2))
        image[top : top + int(rng.integers(8, 50)), left + (right - left) // 3 : right - (right - left) // 3] = 0.8
        image[:, left] = 0.04
    return image


# Cells of the sheet, in units of 128 texels of a 512 x 1024 image: row, column, side.
CELLS = ((0, 0, 4), (0, 4, 2), (2, 4, 2)) + tuple((row, column, 1) for row in range(4) for column in (6, 7))
UNIT = 128


def on_one_sheet(surfaces: Sequence[Surface]) -> list[Surface]:
    """Return the surfaces with all their textures moved onto one image, which therefore has one size whatever is in it.

    The largest texture goes to the largest free cell and is repeated or cropped to fill it; texture coordinates must
    lie in [0, 1]. A renderer compiles one kernel for one textured material: every scene of a set then has the same.
    """
    images: dict[int, Texture] = {}
    for surface in surfaces:
        if isinstance(surface.material.albedo, Texture):
            images[id(surface.material.albedo)] = surface.material.albedo
    order = sorted(images.values(), key=lambda texture: -texture.image.size)
    if len(order) > len(CELLS):
        raise ValueError(f"{len(order)} textures, the sheet has room for {len(CELLS)}")
    whole = np.full((4 * UNIT, 8 * UNIT), 0.5, np.float32)
    place = {}
    for texture, (row, column, side) in zip(order, CELLS, strict=False):
        size = side * UNIT
        repeats = [-(-size // n) for n in texture.image.shape]
        whole[row * UNIT : row * UNIT + size, column * UNIT : column * UNIT + size] = np.tile(texture.image, repeats)[
            :size, :size
        ]
        place[id(texture)] = row, column, side
    sheet_texture = Texture(whole, "textures of the scene")
    materials: dict[int, Material] = {}
    moved = []
    for surface in surfaces:
        material = surface.material
        if surface.uv is None or id(material.albedo) not in place:
            moved.append(surface)
            continue
        row, column, side = place[id(material.albedo)]
        shared = materials.setdefault(id(material), replace(material, albedo=sheet_texture))
        # a texel's width from the edge, so that bilinear interpolation stays within the cell
        inner = 1 / (side * UNIT)
        u, v = (inner + np.clip(surface.uv, 0, 1) * (1 - 2 * inner)).T
        uv = np.column_stack(((column + side * u) / 8, 1 - (row + side * (1 - v)) / 4))
        moved.append(replace(surface, material=shared, uv=uv))
    return moved
