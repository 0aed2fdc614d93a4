"""Hard cases of indirect and ambient light: grooves, furnace, integrating sphere, odd meshes, scales, many samples."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from render.engine import AMBIENT_BOUNCES, render
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
from scene2spad.bench.hard.oracles_optics import integrating_sphere, two_chords_longer_than
from scenes.library import hard_cases as scenes
from scenes.library.hard_cases import hard_case
from scenes.model import Scene

# Merging keeps a pixel's energy, mean and variance; 1 cm lets a histogram of 5 cm bins be compared, too.
SHARP_M = (1e-4, 1e-2)  # of direct and indirect returns
SHARP = RenderSettings(direct_tolerance_m=SHARP_M[0], indirect_tolerance_m=SHARP_M[1], indirect_growth=0)
MERGED = replace(SHARP, indirect_tolerance_m=5e-2)
GROOVE_SPP, SPHERE_SPP = 512, 16  # of each of several independent renders
FURNACE_SPP = 512
BOUNCES = (2, 4, 8, 20)
MANY = 1 << 26
# The icosphere of 82,000 faces is too small by 7.5e-5 in area and up to 7e-5 in radius.
TESSELLATION = 2e-4


@lru_cache(maxsize=2)
def _two_bounces(name: str, seed: int) -> Transient:
    """Render a groove with its first interreflection; kept, since several cases are held against the same one."""
    settings = replace(SHARP, bounces=2, spp=4 * GROOVE_SPP, adaptive=False, grid=4)
    return render(hard_case(name), settings, seed=seed)


def _groove(opening_deg: float, seed: int) -> Outcome:
    scene, edges = hard_case(f"groove-{opening_deg:g}"), np.linspace(4.0, 8.0, 81)
    expected = oracles.groove_interreflection(
        scene, albedo=scenes.GROOVE_ALBEDO, edges_m=edges, opening_deg=opening_deg
    )
    renders = independent(scene, replace(SHARP, bounces=2, spp=GROOVE_SPP, grid=4), seed)
    histograms = np.array([_path_histogram(transient, edges) for transient in renders])
    size = float(np.linalg.norm(expected))
    noise = float(np.linalg.norm(histograms.std(axis=0, ddof=1))) / np.sqrt(len(renders)) / size
    errors = {
        "energy": over_renders([float(h.sum() / expected.sum() - 1) for h in histograms], 1e-4),
        # the norm of 50 bins' noise scatters by a few tenths of itself
        "histogram, nRMSE": Measured(nrmse(histograms.mean(axis=0), expected), 2 * noise + 2e-3),
    }
    return Outcome(errors, clipped(*renders))


def _path_histogram(transient: Transient, edges: np.ndarray) -> np.ndarray:
    """Return image mean of later light per path-length bin, every return even over [near, far]: by their centres alone,
    those that cross an edge would put 1 % of the light into a wrong bin."""
    later = transient.bounces > 1
    near, far = (path[later].astype(float) for path in (transient.path_near_m, transient.path_far_m))
    radiance, width = transient.radiance[later].astype(float), np.maximum(far - near, 1e-9)
    below = [float(radiance @ np.clip((edge - near) / width, 0, 1)) for edge in edges]
    return np.diff(below) / (transient.height * transient.width)


def _furnace(albedo: float, seed: int) -> Outcome:
    """Every pixel has the same expectation: their scatter is the Monte-Carlo error. What more bounces than are followed
    would add is part of the stated error."""
    transient = render(hard_case(f"furnace-{albedo:g}"), RenderSettings(bounces=1, ambient_spp=FURNACE_SPP), seed=seed)
    expected = scenes.FURNACE_EMISSION / (1 - albedo)
    ambient = transient.ambient.astype(float)
    error, stated = (
        float(ambient.std(ddof=1) / np.sqrt(ambient.size)) / expected,
        float(transient.meta["ambient_error"]),
    )
    left_out = albedo**AMBIENT_BOUNCES
    errors = {
        "radiance": Measured(relative(ambient.mean(), expected), left_out + 4 * error + 1e-5),
        "radiance beyond the stated error": Measured(max(left_out - stated, 0.0), 4 * error + 1e-5),
        "standard error": Measured(error, 5e-3),
    }
    return Outcome(errors, clipped(transient))


def _integrating_sphere(albedo: float, seed: int) -> Outcome:
    scene = hard_case(f"sphere-{albedo:g}")
    errors: dict[str, Measured] = {}
    cut = 0
    for bounces in BOUNCES:
        renders = independent(scene, replace(MERGED, bounces=bounces, spp=SPHERE_SPP, grid=2), seed)
        errors |= _against_sphere(scene, renders, albedo, bounces, f" at {bounces} bounces")
        cut += clipped(*renders)
    return Outcome(errors, cut)


def _against_sphere(
    scene: Scene, renders: list[Transient], albedo: float, bounces: int, label: str = ""
) -> dict[str, Measured]:
    expected = integrating_sphere(
        scene, radius_m=scenes.SPHERE_RADIUS_M, offset_m=scenes.SPHERE_OFFSET_M, albedo=albedo, bounces=bounces
    )
    radiance, path, deviation = [], [], []
    for transient in renders:
        got = moments_of(transient, transient.bounces > 1)
        weight, lit = got.total / got.total.sum(), got.total > 0
        lag = np.where(lit, got.mean_m - expected.mean_path_m, 0)
        variance = (weight * (np.where(lit, got.deviation_m, 0) ** 2 + lag**2)).sum() - (weight * lag).sum() ** 2
        radiance.append(float(got.total.mean() / expected.radiance - 1))
        path.append(float((weight * lag).sum()))
        deviation.append(float(np.sqrt(variance / (weight * expected.variance_m2).sum()) - 1))
    return {
        f"radiance{label}": over_renders(radiance, TESSELLATION),
        f"path{label} [m]": over_renders(path, bounces * TESSELLATION),
        f"path's deviation{label}": over_renders(deviation, 2e-3),
    }


def _dark_sphere(seed: int) -> Outcome:
    """Albedo 0.001: the second surface's light is albedo^2, the third's albedo^3, and nothing is lost to rounding."""
    albedo, scene = 0.001, hard_case("sphere-0.001")
    renders = independent(scene, replace(MERGED, bounces=3, spp=SPHERE_SPP, grid=2), seed)
    errors = _against_sphere(scene, renders, albedo, 3)
    # one chord is no longer than 2 r: what comes 5 cm later or more met a third surface, over two chords
    longest = 2 * scenes.SPHERE_RADIUS_M + 0.05
    two = integrating_sphere(
        scene, radius_m=scenes.SPHERE_RADIUS_M, offset_m=scenes.SPHERE_OFFSET_M, albedo=albedo, bounces=2
    )
    legs = two.mean_path_m.ravel() - 4 * scenes.SPHERE_RADIUS_M / 3
    fraction = two_chords_longer_than(longest, scenes.SPHERE_RADIUS_M)
    expected = fraction * albedo**3 / (4 * np.pi**2 * scenes.SPHERE_RADIUS_M**2)
    third = []
    for transient in renders:
        late = centre_path_m(transient) - legs[transient.return_pixel] > longest
        third.append(float(transient.radiance[late].sum(dtype=float) / legs.size / expected - 1))
    # merging over 5 cm blurs the threshold by less: 4e-4 of the share if even, some 5e-3 if one way
    errors["radiance of the third surface"] = over_renders(third, 5e-3)
    return Outcome(errors, clipped(*renders))


def _odd_mesh(name: str, seed: int) -> Outcome:
    odd, clean = (_two_bounces(scene, seed) for scene in (name, "clean-groove"))
    here, there = (moments_of(t, t.bounces == 1) for t in (odd, clean))
    full = (there.total > 0) & ~clean.mixed & ~odd.mixed
    later, later_clean = (float(t.radiance[t.bounces > 1].sum(dtype=float)) for t in (odd, clean))
    errors = {
        "direct energy": Measured(worst(here.total[full], there.total[full]), 2e-5),
        "direct energy, all": Measured(relative(here.total.sum(), there.total.sum()), 1e-4),
        "direct path [m]": Measured(farthest_m(here.mean_m[full], there.mean_m[full]), 1e-5),
        # the same seed: the same paths, but where a triangle's turned frame turns the directions drawn in it; which of
        # two triangles in one place a ray meets, one of them turned, the rays traced beside it may decide
        "indirect energy": Measured(relative(later, later_clean), 0.02 if name in ("inverted", "duplicated") else 1e-5),
        "normals [1]": Measured(float(np.abs(odd.normal.astype(float) - clean.normal.astype(float))[full].max()), 1e-3),
    }
    return Outcome(errors, clipped(odd, clean))


def _scaled(name: str, scale: float, seed: int) -> Outcome:
    """Radiance goes with scale^-2, paths with the scale: against the groove of 1 m."""
    direct_m, indirect_m = (float(np.clip(scale * metres, 1e-4, 10)) for metres in SHARP_M)
    sharp = replace(SHARP, direct_tolerance_m=direct_m, indirect_tolerance_m=indirect_m)
    settings = replace(sharp, bounces=2, spp=4 * GROOVE_SPP, adaptive=False, grid=4)
    scaled, plain = render(hard_case(name), settings, seed=seed), _two_bounces("groove-90", seed)
    here, there = (moments_of(t, t.bounces == 1) for t in (scaled, plain))
    lit = (there.total > 0) & ~plain.mixed & ~scaled.mixed
    later, plain_later = scaled.bounces > 1, plain.bounces > 1
    radiance, plain_radiance = scaled.radiance[later].astype(float), plain.radiance[plain_later].astype(float)
    path = (radiance * centre_path_m(scaled)[later]).sum() / max(radiance.sum(), 1e-300) / scale
    plain_path = (plain_radiance * centre_path_m(plain)[plain_later]).sum() / plain_radiance.sum()
    errors = {
        # how far cells are cut may follow lengths in metres: the same to what a cell, 0.01 rad, is linear to,
        # (0.01)^2 / 12 times a few, by the slant of the walls
        "direct energy": Measured(worst(here.total[lit] * scale**2, there.total[lit]), 5e-5),
        "direct path / scale [m]": Measured(farthest_m(here.mean_m[lit] / scale, there.mean_m[lit]), 1e-4),
        # the same seed takes the same paths, which scaling moves by no more than rounding
        "indirect energy": Measured(relative(radiance.sum() * scale**2, plain_radiance.sum()), 1e-3),
        "indirect path / scale [m]": Measured(abs(float(path - plain_path)), 1e-3),
    }
    return Outcome(errors, clipped(scaled, plain))


def _one_pixel(spp: int, bounces: int, seed: int) -> Outcome:
    """Measure the integrating sphere in one pixel of that many paths: their energy falls into a few metres of path."""
    scene = hard_case("one-pixel")
    transient = render(scene, RenderSettings(bounces=bounces, spp=spp, grid=16), seed=seed)
    expected = integrating_sphere(
        scene, radius_m=scenes.SPHERE_RADIUS_M, offset_m=scenes.SPHERE_OFFSET_M, albedo=0.5, bounces=bounces
    )
    got = moments_of(transient, transient.bounces > 1)
    # a path's weight varies by about its mean, its length by less than 2 m: five of their standard errors
    noise = 5 / np.sqrt(spp)
    errors = {
        "radiance": Measured(relative(got.total[0, 0], expected.radiance), min(noise + TESSELLATION, 1e-2)),
        "path [m]": Measured(farthest_m(got.mean_m, expected.mean_path_m), 2 * noise + bounces * TESSELLATION),
    }
    return Outcome(errors, clipped(transient))


GROOVE = "float64 quadrature of the first interreflection, energy and path histogram"
CLEAN = "the same groove without the odd triangles, laser 10 cm aside"
CHORDS = "L_k = albedo^k / (4 pi^2 r^2), k >= 2, in geometric sums; chords of mean 4r/3 and variance 2r^2/9"
SCALED = "radiance x scale^2 and path / scale are those of the 1 m groove"
FURNACE = f"L / (1 - a), but for the share a^{AMBIENT_BOUNCES} that is left out"
CASES = (
    Case("groove-60", GROOVE, partial(_groove, 60)),
    Case("groove-90", GROOVE, partial(_groove, 90)),
    Case("furnace-0.5", FURNACE, partial(_furnace, 0.5)),
    Case("furnace-0.99", FURNACE, partial(_furnace, 0.99)),
    Case("integrating-sphere-0.5", CHORDS, partial(_integrating_sphere, 0.5), slow=True),
    Case("integrating-sphere-0.99", CHORDS, partial(_integrating_sphere, 0.99), slow=True),
    Case("albedo-0.001", CHORDS, _dark_sphere),
    Case("duplicated-faces", CLEAN, partial(_odd_mesh, "duplicated")),
    Case("coplanar-faces", CLEAN, partial(_odd_mesh, "coplanar")),
    Case("degenerate-triangles", CLEAN, partial(_odd_mesh, "degenerate")),
    Case("inverted-normals", CLEAN, partial(_odd_mesh, "inverted")),
    Case("scaled-1e-3", SCALED, partial(_scaled, "groove-small", 1e-3)),
    Case("scaled-1e3", SCALED, partial(_scaled, "groove-large", 1e3)),
    Case("one-pixel-2^18", CHORDS, partial(_one_pixel, 1 << 18, 4)),
    Case("one-pixel-2^26", CHORDS, partial(_one_pixel, MANY, 2), slow=True),
)
