"""The paints, woods, cloths and metals that one procedural scene is made of, albedos 0.03 to 0.95, and its lights."""

from __future__ import annotations

import numpy as np

from scenes.library.things.parts import Palette, Random
from scenes.library.things.patterns import (
    grain,
    landscape,
    mottled,
    planks,
    print_page,
    rug_pattern,
    spines,
    stripes,
    tiles,
)
from scenes.model import Material, Texture

DARKEST, BRIGHTEST = 0.03, 0.95

# Steady light near 550 to 700 nm [W/(m^2 sr nm)]. Full sun is 1e5 lx and about 1.5 W/(m^2 nm), so an overcast sky of
# 3,300 cd/m^2 seen through the window is 3.3e3 / 1e5 * 1.5 = 0.05; an 800 to 1,500 lm bulb whose light leaves through
# 0.25 m^2 of cloth is 600 to 1,200 cd/m^2, about 0.01 to 0.02.
WINDOW_RADIANCE = 0.05
LAMP_RADIANCE = 0.02


def make_palette(rng: Random) -> Palette:
    """Return a random palette. Whatever the seed, its materials differ from those of another one in albedos alone.

    Kinds: diffuse (plain, or one of at most eleven textures), two roughnesses of coated plastic, one metal, one thin
    glass. So the renderer's kernels are the same for every scene that is made of such palettes.
    """

    def plain(low: float, high: float) -> float:
        # even steps of lightness rather than of albedo
        return float(np.clip(rng.uniform(low**0.5, high**0.5) ** 2, DARKEST, BRIGHTEST))

    def printed(image: np.ndarray) -> Texture:
        return Texture(np.clip(image, DARKEST, BRIGHTEST), "made from the seed")

    wood = plain(0.08, 0.5)
    floor = (
        tiles(rng, plain(0.2, 0.7), 512, 10)
        if rng.random() < 0.3
        else planks(rng, wood, 512, int(rng.integers(16, 34)))
    )
    if rng.random() < 0.25:
        floor = mottled(rng, plain(0.08, 0.5), 0.03, 1, 512)  # carpet
    wall = mottled(rng, plain(0.35, 0.85), 0.02, 6, 256)
    if rng.random() < 0.15:
        wall = 0.5 * wall + 0.5 * np.tile(stripes(rng, 64), (4, 4))
    albedos: dict[str, float | Texture] = {
        "floor": printed(floor),
        "wall": printed(wall),
        "ceiling paint": plain(0.75, BRIGHTEST),
        "rug wool": printed(rug_pattern(rng)),
        "painting 0": printed(landscape(rng, 128, 128)),
        "painting 1": printed(mottled(rng, 0.4, 0.25, 9, 128)),
        "print 0": printed(print_page(rng)),
        "print 1": printed(print_page(rng)),
        "print books": printed(spines(rng)),
        "pattern 0": printed(stripes(rng)),
        "pattern 1": printed(stripes(rng)),
        "sky": 0.5,
        "lamp cloth": 0.7,
    }
    albedos["cloth pattern"] = albedos["pattern 0"]
    albedos["wood veneer"] = printed(grain(rng, wood, 128))
    albedos |= {f"wood {i}": plain(0.06, 0.45) for i in range(3)}
    albedos |= {f"cloth {i}": plain(0.04, 0.85) for i in range(5)}
    albedos |= {f"paint {i}": plain(0.45, BRIGHTEST) for i in range(3)}
    albedos |= {f"dark {i}": plain(DARKEST, 0.12) for i in range(3)}
    albedos |= {f"clay {i}": plain(0.25, 0.8) for i in range(2)}
    albedos |= {f"card {i}": plain(0.2, 0.5) for i in range(2)}
    albedos |= {f"leaf {i}": plain(0.1, 0.4) for i in range(2)}
    albedos |= {f"book cover {i}": plain(0.04, 0.85) for i in range(6)}
    made = {name: Material(albedo=albedo, name=name) for name, albedo in albedos.items()}

    def coated(name: str, albedo: float, roughness: float) -> Material:
        return Material("roughplastic", albedo=albedo, roughness=roughness, ior=1.5, name=name)

    satin = {f"satin {i}": coated(f"satin {i}", plain(0.06, 0.7), 0.3) for i in range(4)}
    gloss = {f"gloss {i}": coated(f"gloss {i}", plain(0.1, 0.9), 0.15) for i in range(4)}
    gloss["gloss dark"] = coated("gloss dark", DARKEST, 0.15)
    steel = Material("roughconductor", roughness=0.3, eta=2.9, k=3.1, name="steel")
    return made | satin | gloss | {"steel": steel, "glass": Material("thindielectric", ior=1.5, name="glass")}


def pick(palette: Palette, rng: Random, family: str) -> Material:
    """Return one of the palette's materials named `family` and a number or word."""
    names = [name for name in palette if name.startswith(f"{family} ")]
    return palette[names[int(rng.integers(len(names)))]]


def repainted(palette: Palette, rng: Random) -> Palette:
    """Return the palette with other woods, cloths and paints under the names that the demo room's furniture asks
    for."""
    varied = {"wood": "wood", "varnished wood": "satin", "white paint": "paint", "sofa cloth": "cloth"}
    varied |= {"cushion cloth": "cloth", "leather": "dark", "rubber": "satin", "clay": "clay"}
    return {**palette, **{name: pick(palette, rng, family) for name, family in varied.items()}}
