"""Hard cases of indirect and ambient light: grooves, furnace, integrating sphere, odd meshes, scales, many samples."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from render.engine import AMBIENT_BOUNCES, render
from render.settings import RenderSettings
from render.transient import Transient
from scenes import hard_cases as scenes
from scenes.hard_cases import hard_case
from scenes.model import Scene
from studies.bench import oracles
from studies.bench.hard_case import (
    SIGMAS,
    Case,
    Measured,
    Outcome,
    centre_path_m,
    clipped,
    farthest_m,
    moments_of,
    relative,
    standard_error,
    worst,
)
from studies.bench.oracles_optics import geometric_sum, integrating_sphere

# Unmerged indirect returns, so that path statistics are the renderer's and not the merging's.
SHARP = {"direct_tolerance_m": 1e-4, "indirect_tolerance_m": 1e-3, "indirect_growth": 0}
GROOVE_SPP, SPHERE_SPP = 2048, 256
BOUNCES = (2, 4, 8, 20)
MANY = 1 << 26
# The icosphere of 82,000 faces is too small by 7.5e-5 in area and up to 7e-5 in radius.
TESSELLATION = 2e-4


@lru_cache(maxsize=4)
def _groove_histogram(opening_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Bin edges [m] and the image mean of the first interreflection in the groove of that angle, 16 x 12 pixels."""
    edges = np.linspace(4.0, 8.0, 81)
    values = oracles.groove_interreflection(
        hard_case(f"groove-{opening_deg:g}"), albedo=scenes.GROOVE_ALBEDO, edges_m=edges, opening_deg=opening_deg
    )
    return edges, values


@lru_cache(maxsize=4)
def _two_bounces(name: str, seed: int) -> Transient:
    """A groove with its first interreflection; kept, since several cases are held against the same one."""
    return render(hard_case(name), RenderSettings(bounces=2, spp=GROOVE_SPP, grid=4, **SHARP), seed=seed)


def _groove(opening_deg: float, seed: int) -> Outcome:
    edges, expected = _groove_histogram(opening_deg)
    halves = [_two_bounces(f"groove-{opening_deg:g}", s) for s in (seed, seed + 1)]
    first, second = (_path_histogram(half, edges) for half in halves)
    mean = (first + second) / 2
    # the noise of the mean of two independent renders is half of their difference
    noise = float(np.linalg.norm(first - second) / 2 / np.linalg.norm(expected))
    error = float(np.hypot(*map(standard_error, halves)) / 2)
    errors = {
        "energy": Measured(relative(mean.sum(), expected.sum()), SIGMAS * error + 1e-4),
        "histogram, nRMSE": Measured(
            float(np.linalg.norm(mean - expected) / np.linalg.norm(expected)), 2 * noise + 2e-3
        ),
    }
    return Outcome(errors, clipped(*halves))


def _path_histogram(transient: Transient, edges: np.ndarray) -> np.ndarray:
    later = transient.bounces > 1
    values = np.histogram(centre_path_m(transient)[later], bins=edges, weights=transient.radiance[later].astype(float))
    return values[0] / (transient.height * transient.width)


def _furnace(albedo: float, seed: int) -> Outcome:
    """Every pixel has the same expectation: their scatter is the Monte-Carlo error."""
    transient = render(hard_case(f"furnace-{albedo:g}"), RenderSettings(bounces=1), seed=seed)
    expected = scenes.FURNACE_EMISSION * geometric_sum(albedo, 0, AMBIENT_BOUNCES - 1)
    ambient = transient.ambient.astype(float)
    error = float(ambient.std(ddof=1) / np.sqrt(ambient.size)) / expected
    errors = {
        "radiance": Measured(relative(ambient.mean(), expected), SIGMAS * error + 1e-5),
        "standard error": Measured(error, 5e-3),
    }
    return Outcome(errors, clipped(transient))


def _integrating_sphere(albedo: float, seed: int) -> Outcome:
    scene = hard_case(f"sphere-{albedo:g}")
    errors, renders = {}, []
    for bounces in BOUNCES:
        transient = render(scene, RenderSettings(bounces=bounces, spp=SPHERE_SPP, grid=2, **SHARP), seed=seed)
        errors |= _against_sphere(scene, transient, albedo, bounces, f" at {bounces} bounces")
        renders.append(transient)
    return Outcome(errors, clipped(*renders))


def _against_sphere(
    scene: Scene, transient: Transient, albedo: float, bounces: int, label: str = "", spp: int = SPHERE_SPP
) -> dict[str, Measured]:
    expected = integrating_sphere(
        scene, radius_m=scenes.SPHERE_RADIUS_M, offset_m=scenes.SPHERE_OFFSET_M, albedo=albedo, bounces=bounces
    )
    got = moments_of(transient, transient.bounces > 1)
    samples = got.total.size * spp
    error = standard_error(transient)
    lag = (got.total * (got.mean_m - expected.mean_path_m)).sum() / got.total.sum()
    # weights of relative variance v leave n / (1 + v) of n samples, and v / n is the squared error of the energy
    deviation = float(np.sqrt(expected.variance_m2.mean()))
    path_error = deviation * np.sqrt(1 / samples + error**2)
    # the variance of a variance of an almost normal path, 2 sigma^4 / n; a mixture of orders has longer tails
    within = (got.total * (got.deviation_m**2 + (got.mean_m - expected.mean_path_m) ** 2)).sum() / got.total.sum()
    spread_error = np.sqrt(6) / 2 * path_error / deviation
    return {
        f"radiance{label}": Measured(relative(got.total.mean(), expected.radiance), SIGMAS * error + TESSELLATION),
        f"path{label} [m]": Measured(abs(float(lag)), SIGMAS * path_error + bounces * TESSELLATION),
        f"path's deviation{label}": Measured(
            relative(np.sqrt(within), np.sqrt(expected.variance_m2.mean())), SIGMAS * spread_error + TESSELLATION
        ),
    }


def _dark_sphere(seed: int) -> Outcome:
    """Albedo 0.001: the second surface's light is albedo^2, the third's albedo^3, and nothing is lost to rounding."""
    albedo = 0.001
    settings = RenderSettings(bounces=3, spp=SPHERE_SPP, grid=2, **{**SHARP, "indirect_tolerance_m": 1e-4})
    scene = hard_case("sphere-0.001")
    transient = render(scene, settings, seed=seed)
    errors = _against_sphere(scene, transient, albedo, 3)
    third = transient.radiance[transient.bounces == 3].astype(float)
    got = third.sum() / (transient.height * transient.width)
    expected = albedo**3 / (4 * np.pi**2 * scenes.SPHERE_RADIUS_M**2)
    # returns that merged with none other are samples: the error of their sum is the root of their squares' sum
    error = float(np.sqrt((third**2).sum()) / max(third.sum(), 1e-300))
    # returns of the third surface that merge with the second's count as its: a few in a thousand
    errors["radiance of the third surface"] = Measured(relative(got, expected), SIGMAS * error + 0.01)
    return Outcome(errors, clipped(transient))


def _odd_mesh(name: str, seed: int) -> Outcome:
    odd, clean = (_two_bounces(scene, seed) for scene in (name, "clean-groove"))
    here, there = (moments_of(t, t.bounces == 1) for t in (odd, clean))
    full = (there.total > 0) & ~clean.mixed & ~odd.mixed
    later, later_clean = (float(t.radiance[t.bounces > 1].sum(dtype=float)) for t in (odd, clean))
    error = float(np.hypot(standard_error(odd), standard_error(clean)))
    errors = {
        "direct energy": Measured(worst(here.total[full], there.total[full]), 2e-5),
        "direct energy, all": Measured(relative(here.total.sum(), there.total.sum()), 1e-4),
        "direct path [m]": Measured(farthest_m(here.mean_m[full], there.mean_m[full]), 1e-5),
        "indirect energy": Measured(relative(later, later_clean), SIGMAS * error),
        "normals [1]": Measured(float(np.abs(odd.normal.astype(float) - clean.normal.astype(float))[full].max()), 1e-3),
    }
    return Outcome(errors, clipped(odd, clean))


def _scaled(name: str, scale: float, seed: int) -> Outcome:
    """Radiance goes with scale^-2, paths with the scale: against the groove of 1 m and, indirect light, quadrature."""
    widths = {
        key: float(np.clip(scale * SHARP[key], 1e-4, 10)) for key in ("direct_tolerance_m", "indirect_tolerance_m")
    }
    settings = RenderSettings(bounces=2, spp=GROOVE_SPP, grid=4, indirect_growth=0, **widths)
    scaled, plain = render(hard_case(name), settings, seed=seed), _two_bounces("groove-90", seed)
    here, there = (moments_of(t, t.bounces == 1) for t in (scaled, plain))
    lit = (there.total > 0) & ~plain.mixed & ~scaled.mixed
    plain_later = plain.radiance[plain.bounces > 1].sum(dtype=float)
    edges, expected = _groove_histogram(90.0)
    later = scaled.bounces > 1
    radiance, path = scaled.radiance[later].astype(float), centre_path_m(scaled)[later] / scale
    error = standard_error(scaled)
    centre = (edges[1:] + edges[:-1]) / 2
    mean = (expected * centre).sum() / expected.sum()
    deviation = np.sqrt((expected * (centre - mean) ** 2).sum() / expected.sum())
    mean_error = deviation * np.hypot(error, 1 / np.sqrt(max(later.sum(), 1)))
    errors = {
        # how far cells are cut may follow lengths in metres: the same to what a cell, 0.01 rad, is linear to,
        # (0.01)^2 / 12 times a few, by the slant of the walls
        "direct energy": Measured(worst(here.total[lit] * scale**2, there.total[lit]), 5e-5),
        "direct path / scale [m]": Measured(farthest_m(here.mean_m[lit] / scale, there.mean_m[lit]), 1e-4),
        "indirect energy": Measured(
            relative(radiance.sum() * scale**2 / plain.depth_m.size, expected.sum()), SIGMAS * error + 1e-4
        ),
        # the same seed takes the same paths, which scaling moves by no more than rounding
        "indirect energy against 1 m": Measured(relative(radiance.sum() * scale**2, plain_later), 1e-3),
        "indirect path / scale [m]": Measured(
            abs(float((radiance * path).sum() / max(radiance.sum(), 1e-300) - mean)), SIGMAS * mean_error + 1e-3
        ),
    }
    return Outcome(errors, clipped(scaled, plain))


def _one_pixel(spp: int, seed: int) -> Outcome:
    """The integrating sphere in one pixel of that many paths: all their energy falls into a few metres of path."""
    scene, bounces, albedo = hard_case("one-pixel"), 4, 0.5
    transient = render(scene, RenderSettings(bounces=bounces, spp=spp, grid=16), seed=seed)
    errors = _against_sphere(scene, transient, albedo, bounces, spp=spp)
    if spp == MANY:
        errors["radiance"] = errors["radiance"]._replace(limit=1e-3)
    return Outcome(errors, clipped(transient))


GROOVE = "float64 quadrature of the first interreflection, energy and path histogram"
CLEAN = "the same groove without the odd triangles, laser 10 cm aside"
CHORDS = "L_k = albedo^k / (4 pi^2 r^2), k >= 2, in geometric sums; chords of mean 4r/3 and variance 2r^2/9"
SCALED = "radiance x scale^2 and path / scale: direct those of the 1 m groove, indirect by quadrature"
CASES = (
    Case("groove-60", GROOVE, partial(_groove, 60)),
    Case("groove-90", GROOVE, partial(_groove, 90)),
    Case("furnace-0.5", f"L (1 - a^{AMBIENT_BOUNCES}) / (1 - a)", partial(_furnace, 0.5)),
    Case("furnace-0.99", f"L (1 - a^{AMBIENT_BOUNCES}) / (1 - a)", partial(_furnace, 0.99)),
    Case("integrating-sphere-0.5", CHORDS, partial(_integrating_sphere, 0.5)),
    Case("integrating-sphere-0.99", CHORDS, partial(_integrating_sphere, 0.99)),
    Case("albedo-0.001", CHORDS, _dark_sphere),
    Case("duplicated-faces", CLEAN, partial(_odd_mesh, "duplicated")),
    Case("coplanar-faces", CLEAN, partial(_odd_mesh, "coplanar")),
    Case("degenerate-triangles", CLEAN, partial(_odd_mesh, "degenerate")),
    Case("inverted-normals", CLEAN, partial(_odd_mesh, "inverted")),
    Case("scaled-1e-3", SCALED, partial(_scaled, "groove-small", 1e-3)),
    Case("scaled-1e3", SCALED, partial(_scaled, "groove-large", 1e3)),
    Case("one-pixel-2^18", CHORDS, partial(_one_pixel, 1 << 18)),
    Case("one-pixel-2^26", CHORDS, partial(_one_pixel, MANY), slow=True),
)
