"""Hard cases of glass, mirrors and cut-outs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.bench.hard import oracles
from scene2spad.bench.hard.case import (
    Case,
    Measured,
    Outcome,
    centre_path_m,
    clipped,
    farthest_m,
    independent,
    moments_of,
    nrmse,
    over_renders,
    relative,
    worst,
)
from scene2spad.bench.hard.oracles_optics import (
    caustic_moments,
    fresnel,
    mirror_return,
    pane_transmission,
    slab_moments,
)
from scenes.library import hard_cases as scenes
from scenes.library.hard_cases import hard_case
from scenes.model import Scene

SMOOTH = RenderSettings(bounces=1, grid=4, direct_tolerance_m=1e-4)
EDGES = RenderSettings(bounces=1, grid=16, edge_threshold=0, direct_tolerance_m=1e-4)
CAUSTIC = RenderSettings(bounces=2, grid=4, spp=256, indirect_tolerance_m=1e-2, indirect_growth=0)
# A specular return is one number per pixel, in float32 from a handful of operations.
SPECULAR_ENERGY, SPECULAR_PATH_M = 1e-4, 1e-5


def _specular(
    scene: Scene, transient: Transient, kept: np.ndarray, toward: np.ndarray, reflectance: float, one_way_m: float
) -> dict[str, Measured]:
    """Energy and path of a specular return in the pixel that looks `toward` it, and what else there is of its kind."""
    pixel, expected = mirror_return(scene.camera, scene.laser, toward, reflectance, one_way_m)
    got = moments_of(transient, kept)
    return {
        "energy": Measured(relative(got.total[pixel], expected), SPECULAR_ENERGY),
        "path [m]": Measured(farthest_m(got.mean_m[pixel], one_way_m), SPECULAR_PATH_M),
        "energy in other pixels": Measured(float((got.total.sum() - got.total[pixel]) / expected), SPECULAR_ENERGY),
    }


def _mirror(seed: int) -> Outcome:
    scene = hard_case("mirror")
    transient = render(scene, SMOOTH, seed=seed)
    turn = np.radians(scenes.MIRROR_TILT_DEG)
    toward, distance = -np.array([np.sin(turn), 0, np.cos(turn)]), scenes.MIRROR_M * np.cos(turn)
    every = np.ones(transient.returns, bool)
    errors = _specular(scene, transient, every, toward, scenes.MIRROR_REFLECTANCE, 2 * distance)
    return Outcome(errors, clipped(transient))


def _caustic(seed: int) -> Outcome:
    scene = hard_case("caustic")
    expected = caustic_moments(
        scene,
        wall_m=scenes.CAUSTIC_WALL_M,
        panel_m=scenes.CAUSTIC_PANEL_M,
        depths_m=scenes.CAUSTIC_DEPTHS_M,
        reflectance=scenes.MIRROR_REFLECTANCE,
        albedo=scenes.ALBEDO,
    )
    bright = np.isfinite(expected.total)
    # clear of the caustic's ends by two pixels, since the metal blurs it a little
    inner = bright.copy()
    for axis in (0, 1):
        for step in (-2, -1, 1, 2):
            inner &= np.roll(bright, step, axis)
    inner[[0, 1, -2, -1], :] = inner[:, [0, 1, -2, -1]] = False
    renders = independent(scene, CAUSTIC, seed)
    got = [moments_of(transient, transient.bounces > 1) for transient in renders]
    whole = expected.total[inner].sum()
    mean = np.mean([one.total for one in got], axis=0)
    errors = {
        # GGX's tails end at no pixel
        "energy": over_renders([float(one.total[inner].sum() / whole - 1) for one in got], 0.005),
        "energy, nRMSE of pixels": Measured(nrmse(mean[inner], expected.total[inner]), 0.03),
        "path [m]": over_renders([float((one.mean_m - expected.mean_m)[inner].mean()) for one in got], 2e-3),
    }
    return Outcome(errors, clipped(*renders))


def _corner_cube(seed: int) -> Outcome:
    scene = hard_case("corner-cube")
    transient = render(scene, replace(SMOOTH, bounces=3), seed=seed)  # the light meets all three faces
    apex = np.array(scenes.CUBE_APEX_M)
    every = np.ones(transient.returns, bool)
    one_way = 2 * float(np.linalg.norm(apex))
    errors = _specular(scene, transient, every, apex, scenes.MIRROR_REFLECTANCE**3, one_way)
    return Outcome(errors, clipped(transient))


def _window(seed: int) -> Outcome:
    scene = hard_case("window")
    transient = render(scene, SMOOTH, seed=seed)
    front = centre_path_m(transient) < scenes.PANE_M + scenes.WALL_M
    normal = float(fresnel(1.0, scenes.GLASS_IOR))
    errors = _specular(scene, transient, front, np.array([0, 0, -1.0]), 2 * normal / (1 + normal), 2 * scenes.PANE_M)
    expected = oracles.plane_moments(
        scene,
        distance_m=scenes.WALL_M,
        tilt_deg=0,
        albedo=scenes.ALBEDO,
        transmission=lambda cosine: pane_transmission(cosine, scenes.GLASS_IOR) ** 2,
    )
    behind = moments_of(transient, ~front)
    depth = scenes.WALL_M / -scene.camera.rays()[..., 2]
    errors |= {
        "wall's energy": Measured(worst(behind.total, expected.total), 1e-4),
        # a ray that goes on behind glass begins 1e-4 (1 + |p|) off it, which moves it sideways by that times tan(angle)
        "wall's path [m]": Measured(farthest_m(behind.mean_m, expected.mean_m), 1e-4),
        "depth label [m]": Measured(farthest_m(transient.depth_m.astype(float), depth), 5e-5),
    }
    return Outcome(errors, clipped(transient))


def _slab(seed: int) -> Outcome:
    scene = hard_case("slab")
    transient = render(scene, SMOOTH, seed=seed)
    expected = slab_moments(
        scene,
        wall_m=scenes.WALL_M,
        thickness_m=scenes.SLAB_THICKNESS_M,
        ior=scenes.GLASS_IOR,
        albedo=scenes.ALBEDO,
    )
    # the slab's own reflections come before 2 (1.15 m + 0.15 m)
    behind = moments_of(transient, centre_path_m(transient) > scenes.WALL_M)
    depth = scenes.WALL_M / -scene.camera.rays()[..., 2]
    errors = {
        "wall's energy": Measured(worst(behind.total, expected.total), 1e-3),
        # straight on instead of refracted, 1.25 degrees off the axis: t (n - 1/n) theta^2 = 0.12 mm
        "wall's path [m]": Measured(farthest_m(behind.mean_m, expected.mean_m), 2e-4),
        "depth label [m]": Measured(farthest_m(transient.depth_m.astype(float), depth), 1e-4),
    }
    return Outcome(errors, clipped(transient))


def _leaf(seed: int) -> Outcome:
    scene = hard_case("leaf")
    transient = render(scene, EDGES, seed=seed)
    expected = oracles.disk_before_wall(
        scene,
        disk_m=scenes.LEAF_M,
        radius_m=scenes.LEAF_RADIUS_M,
        disk_albedo=0.3,
        wall_m=scenes.WALL_M,
        wall_albedo=scenes.ALBEDO,
    )
    front = centre_path_m(transient) < scenes.LEAF_M + scenes.WALL_M
    leaf, wall = moments_of(transient, front).total, moments_of(transient, ~front).total
    inside, outside = expected.wall == 0, expected.leaf == 0
    errors = {
        "leaf's energy": Measured(relative(leaf.sum(), expected.leaf.sum()), 2e-3),
        "wall's energy": Measured(relative(wall.sum(), expected.wall.sum()), 2e-3),
        # 16 x 16 cells know the coverage of a rim pixel to about 16^-1.5 = 1.6 %; a fifth of the leaf's pixels are such
        "leaf, nRMSE of pixels": Measured(nrmse(leaf, expected.leaf), 1e-2),
        "wall, nRMSE of pixels": Measured(nrmse(wall, expected.wall), 1e-2),
        "off the rim": Measured(
            max(worst(leaf[inside], expected.leaf[inside]), worst(wall[outside], expected.wall[outside])), 1e-4
        ),
        "through the leaf": Measured(float(wall[inside].sum() + leaf[outside].sum()), 0),
    }
    return Outcome(errors, clipped(transient))


CASES = (
    Case("mirror", "R I / (D^2 Omega), D = 2d, in the pixel that sees the laser in the mirror", _mirror),
    Case("caustic", "I R cos / D^2 from the laser's mirror image in polished metal, on a wall", _caustic),
    Case("corner-cube", "R^3 I / (D^2 Omega), D = 2d to the apex", _corner_cube),
    Case("window", "own return 2F/(1+F) at normal incidence; the wall behind times T(angle)^2", _window),
    Case("thick-slab", "every ray refracted: (1-F)^4, delay 2t(n-1), spreading over d - t + t/n", _slab),
    Case("cut-out-leaf", "a disk before a wall on 64 x 64 rays a pixel", _leaf),
)
