"""List what `bench render` measures: scenes, methods, qualities and references. Plain data, no renderer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from scenes.constants import REFERENCE_BINS, REFERENCE_PERIOD_S, SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from scenes.io.relief import data_folder
from scenes.library.catalog import load_scene
from scenes.model import Ambient, Laser, Material, Scene, Surface

BINS = REFERENCE_BINS
BIN_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PERIOD_S / REFERENCE_BINS
FLASH_FOV_DEG = 34.0
BOUNCES = {"direct": 1, "full": 5}  # surfaces; mitransient's max_depth is one more, the laser being a vertex of its own
SCENES = {
    "flash": "the built-in living room, 34 degrees, lit by a flash that fills the field of view",
    "lamp": "the built-in living room, its own camera, lit by an isotropic lamp at the camera",
    "artist": "an artist's living room (Mitsuba XML), 34 degrees, lit by the same flash",
    "artist-lamp": "the same with its own camera, lit by an isotropic lamp there",
    "gallery": "a bare room with six finely meshed bodies, 60 degrees, lit by an isotropic lamp at the camera",
    "groove": "a 90-degree V-groove, 34 degrees, lit by the same flash",
    "hall": "a varnished stairwell, 34 degrees, lit by the same flash",
    "hall-lamp": "the same with its own camera, lit by an isotropic lamp there",
    "washroom": "chrome and glossy tiles, 34 degrees, lit by the same flash; its glass is left out, mirrors are grey",
}
SIZES = {
    "flash": (64, 128, 256),
    "lamp": (64, 128, 256),
    "artist": (64, 128),
    "artist-lamp": (64, 128),
    "gallery": (64, 128, 256),
    "groove": (64, 128),
    "hall": (64, 256),
    "hall-lamp": (64, 256),
    "washroom": (64,),
}
QUICK_SIZES = dict.fromkeys(SCENES, (64,)) | {"flash": (64, 128), "lamp": (64, 128)}
LAMPS = ("lamp", "artist-lamp", "gallery", "hall-lamp")
_BUILT_IN = {"groove": "corner", "flash": "living-room", "lamp": "living-room", "hall-lamp": "hall"}
ARTIST_FILE = Path("scenes/living-room/scene.xml")  # below the data folder
MIRROR_ALBEDO = 0.5


@dataclass(frozen=True)
class Method:
    """One way to render. `quality` is a grid (direct rays a pixel side) for ours direct, samples a pixel otherwise."""

    name: str
    code: str  # ours or mitransient
    unit: str
    sampler: str = ""
    filter: bool = False


OURS_DIRECT = Method("ours direct", "ours", "grid")
UNBIASED = Method("ours unbiased", "ours", "spp")
FILTERED = Method("ours filtered", "ours", "spp", filter=True)
MULTIJITTER = Method("mitransient multijitter", "mitransient", "spp", "multijitter")
INDEPENDENT = Method("mitransient independent", "mitransient", "spp", "independent")
METHODS = {
    "direct": (OURS_DIRECT, MULTIJITTER, INDEPENDENT),
    "full": (UNBIASED, FILTERED, MULTIJITTER, INDEPENDENT),
}


def qualities(method: Method, transport: str, size: int, quick: bool) -> tuple[int, ...]:
    """Return the qualities measured, by rising cost. Larger images get fewer."""
    if method is OURS_DIRECT:
        return (1, 2, 3, 5, 8, 12) if size <= 128 else (1, 2, 3, 5)
    if method is INDEPENDENT:  # plain Monte Carlo: its slope is known
        return (16, 64) if size <= 64 else (16,)
    if method is MULTIJITTER and transport == "direct":
        return (16, 64, 256, 1024) if size <= 64 else (16, 64, 256)
    if method is MULTIJITTER and size <= 64 and not quick:
        return (16, 64, 256, 1024)
    if method is MULTIJITTER:
        return (16, 64, 256) if size <= 64 or not quick else (16, 64)
    if method is FILTERED:
        return (2, 4, 16, 64, 256) if size <= 64 or (size <= 128 and not quick) else (1, 4, 16, 64)
    return (4, 16, 64, 256) if size <= 64 or (size <= 128 and not quick) else (4, 16, 64)


def grid_beside(spp: int) -> int:
    """Return direct rays a pixel side that go with indirect `spp`, so that direct light costs least error for its
    time."""
    return 4 if spp < 16 else 5 if spp < 64 else 7 if spp < 128 else 9 if spp < 256 else 12


def reference_passes(transport: str, size: int) -> tuple[int, int]:
    """Return (passes, samples a pixel in each) of one half of the reference, multijittered.

    The larger the image, the fewer: crosswise, noise that is independent in N bins cancels as 1/sqrt(N).
    """
    spp = {"direct": {64: 2048, 128: 512, 256: 256}, "full": {64: 1024, 128: 256, 256: 256}}[transport]
    wanted = next((n for limit, n in spp.items() if size <= limit), 256)
    a_pass = max(1, min(wanted, (1 << 24) // size**2))
    return -(-wanted // a_pass), a_pass


def bench_scene(name: str, size: int, data: Path | None = None) -> Scene:
    """Return one of SCENES, `size` x `size` pixels. Raises InputError where the artist's file is absent."""
    if name.startswith("artist"):
        path = data_folder(data) / ARTIST_FILE
        if not path.is_file():
            raise InputError(f"{path}: file not found (--data or SCENE2SPAD_DATA tell the folder)")
        scene = load_scene(str(path), width=size, height=size)
    else:
        scene = load_scene(_BUILT_IN.get(name, name), width=size, height=size)
    if name in LAMPS:
        scene = replace(scene, laser=Laser("flood", cone_deg=360))
    else:
        scene = replace(scene, camera=replace(scene.camera, fov_deg=FLASH_FOV_DEG), laser=Laser("flood"))
    return comparable(replace(scene, name=name))


def comparable(scene: Scene) -> Scene:
    """Return the scene without what the two codes do not share, so that both estimate one quantity.

    Steady light goes (only the laser is compared). A delta light lights nothing through glass or cut-outs in
    mitransient, and nothing in perfect mirrors in either's shadow rays: glass goes, cut-outs are solid, mirrors grey.
    """
    changed: dict[int, Material] = {}
    kept: list[Surface] = []
    for surface in scene.surfaces:
        material = surface.material
        if material.is_glass:
            continue
        if id(material) not in changed:
            changed[id(material)] = _opaque(material)
        kept.append(replace(surface, material=changed[id(material)], emission=0.0))
    return replace(scene, surfaces=tuple(kept), ambient=Ambient())


def _opaque(material: Material) -> Material:
    if material.kind == "conductor":
        return Material(name=material.name, albedo=MIRROR_ALBEDO)
    return replace(material, opacity=1.0) if material.lets_light_through else material
