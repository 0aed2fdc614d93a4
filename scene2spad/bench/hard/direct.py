"""Hard cases of direct light: near and far, wrapping, grazing, silhouettes, thin things, shadows and odd meshes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from render.direct.cell_tree import MAX_CELLS
from render.engine import render
from render.settings import RenderSettings
from scene2spad.bench.hard import oracles
from scene2spad.bench.hard.case import (
    Case,
    Measured,
    Outcome,
    centre_path_m,
    clipped,
    farthest_m,
    moments_of,
    nrmse,
    relative,
    worst,
)
from scene2spad.bench.hard.oracles import Moments
from scene2spad.bench.hard.oracles_optics import wall_on_sensor
from scenes.library import hard_cases as scenes
from scenes.library.hard_cases import hard_case
from spad.detection.detect import sense
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.sensor.model import PRESETS, PhotonBudget

SMOOTH = RenderSettings(bounces=1, grid=4, direct_tolerance_m=1e-4)
FINE = RenderSettings(bounces=1, grid=8, direct_tolerance_m=1e-4)
EDGES = RenderSettings(bounces=1, grid=16, edge_threshold=0, direct_tolerance_m=1e-4)
# A cell's radiance is its centre's: with 16 x 4 cells over 34 degrees cos^4 is off by 4/24 (0.0096)^2 = 2e-5.
CELL_ENERGY = 5e-5
FLOAT32 = float(np.finfo(np.float32).eps)


def _frontal(name: str, distance_m: float, path_limit_m: float, seed: int) -> Outcome:
    scene = hard_case(name)
    transient = render(scene, SMOOTH, seed=seed)
    expected = oracles.plane_moments(scene, distance_m=distance_m, tilt_deg=0, albedo=scenes.ALBEDO)
    got = moments_of(transient)
    errors = {
        "energy": Measured(worst(got.total, expected.total), CELL_ENERGY),
        "path [m]": Measured(farthest_m(got.mean_m, expected.mean_m), path_limit_m),
    }
    return Outcome(errors, clipped(transient))


def _on_sensor(name: str, distance_m: float, seed: int) -> Outcome:
    """Measure the frontal wall, and the counts of the reference sensor: where they lie and how many of them wrapped."""
    outcome = _frontal(name, distance_m, 8 * FLOAT32 * distance_m, seed)
    scene = hard_case(name)
    transient, sensor, budget = render(scene, SMOOTH, seed=seed), PRESETS["reference"], PhotonBudget(50, 0)
    pixels = transient.height * transient.width
    counts, wrapped = expected_counts(transient, sensor, rates_for(transient, sensor, budget), slice(0, pixels))
    expected = wall_on_sensor(scene, sensor, distance_m=distance_m)
    histogram = counts.sum(dim=0).numpy() / (budget.signal * pixels)
    reported = sense(transient, sensor, budget, seed=seed).meta["wrapped"]
    outcome.errors.update(
        {
            "counts": Measured(nrmse(histogram, expected.histogram), 1e-3),
            "wrapped share [1]": Measured(abs(wrapped / (budget.signal * pixels) - expected.wrapped), 1e-4),
            "wrapped as reported [1]": Measured(abs(reported - expected.wrapped), 1e-4),
            "brightest bin [bins]": Measured(abs(int(histogram.argmax()) - int(expected.histogram.argmax())), 0),
        }
    )
    return outcome


def _grazing(incidence_deg: float, seed: int) -> Outcome:
    scene = hard_case(f"grazing-{incidence_deg:g}")
    transient = render(scene, FINE, seed=seed)
    expected = oracles.plane_moments(
        scene, distance_m=scenes.WALL_M, tilt_deg=incidence_deg, albedo=scenes.ALBEDO, per_side=12
    )
    got = moments_of(transient)
    errors = {
        "energy": Measured(worst(got.total, expected.total), 1e-3),
        # a pixel spans up to 0.6 m of path: its mean must be known to 1 % of its standard deviation
        "path [deviations]": Measured(
            farthest_m(got.mean_m / expected.deviation_m, expected.mean_m / expected.deviation_m), 1e-2
        ),
        "spread": Measured(worst(got.deviation_m, expected.deviation_m), 1e-2),
    }
    return Outcome(errors, clipped(transient))


def _horizon(seed: int) -> Outcome:
    scene = hard_case("horizon")
    transient = render(scene, EDGES, seed=seed)
    expected = oracles.bounded_plane_moments(
        scene, distance_m=scenes.WALL_M, tilt_deg=89, half_size_m=5, albedo=scenes.ALBEDO, per_side=128
    )
    got = moments_of(transient)
    lit = expected.total > 1e-3 * expected.total.max()
    edge_m = 2 * (scenes.WALL_M + 5)
    # at its far edge the wall is h = 3 cos(89) m aside: one cell of one 16th of a pixel spans p^2 / (2 h) of path
    cell_m = edge_m**2 / 2 / (scenes.WALL_M * np.cos(np.radians(89))) / scene.camera.focal_px / 16
    errors = {
        "energy, nRMSE of pixels": Measured(nrmse(got.total, expected.total), 1e-3),
        "energy": Measured(relative(got.total.sum(), expected.total.sum()), 1e-3),
        "path [deviations]": Measured(
            farthest_m((got.mean_m / expected.deviation_m)[lit], (expected.mean_m / expected.deviation_m)[lit]), 0.02
        ),
        "light beyond the far edge [m]": Measured(max(0.0, float(transient.path_far_m.max()) - edge_m), 0.1 * cell_m),
    }
    return Outcome(errors, clipped(transient))


def _silhouette(seed: int) -> Outcome:
    scene = hard_case("silhouette")
    transient = render(scene, EDGES, seed=seed)
    coverage = oracles.sphere_coverage(
        scene.camera, distance_m=scenes.BALL_M, radius_m=scenes.BALL_RADIUS_M, per_side=32
    )
    got = moments_of(transient)
    # at the limb cos = sqrt(2 s / r): a pixel covered by less than a tenth holds under 1 % of a full one's light
    limb = (coverage > 0.1) & (coverage < 1)
    paint = partial(oracles.paint, albedo=0.7)
    ball = partial(
        oracles.sphere_moments, scene, distance_m=scenes.BALL_M, radius_m=scenes.BALL_RADIUS_M, reflected=paint
    )
    expected = ball(per_side=192, pixels=limb)
    whole = ball(per_side=32).total.sum()
    errors = {
        "limb energy": Measured(worst(got.total[limb], expected.total), 1e-2),
        # a limb pixel's path deviates by 2.5 to 6 cm, and changes fastest in the last cell
        "limb path [m]": Measured(farthest_m(got.mean_m[limb], expected.mean_m), 1e-3),
        "energy": Measured(relative(got.total.sum(), whole), 1e-4),
    }
    return Outcome(errors, clipped(transient))


def _glint(seed: int) -> Outcome:
    scene = hard_case("glint")
    steel = partial(oracles.metal, roughness=scenes.GLINT_ROUGHNESS, eta=scenes.GLINT_ETA, k=scenes.GLINT_K)
    ball = partial(oracles.sphere_moments, distance_m=scenes.GLINT_M, radius_m=scenes.GLINT_RADIUS_M, reflected=steel)
    errors: dict[str, Measured] = {}
    notes = 0
    # the highlight lies on a corner of four pixels, which share it as cells a third as wide can tell; or within one
    for width, height in ((16, 12), (15, 11)):
        seen = replace(scene, camera=scenes.camera(width, height))
        transient = render(seen, SMOOTH, seed=seed)
        middle = np.zeros((height, width), bool)
        middle[height // 2 - 2 : height // 2 + 2, width // 2 - 2 : width // 2 + 2] = True
        expected = ball(seen, per_side=512, pixels=middle)
        got = Moments(*(values[middle] for values in moments_of(transient)))
        bright = expected.total > 1e-2 * expected.total.max()
        where = f"{width} x {height}"
        errors |= {
            f"energy, nRMSE of pixels, {where}": Measured(nrmse(got.total, expected.total), 0.06),
            f"energy, {where}": Measured(relative(got.total.sum(), expected.total.sum()), 0.01),
            f"path [m], {where}": Measured(farthest_m(got.mean_m[bright], expected.mean_m[bright]), 1e-3),
        }
        notes += clipped(transient)
    return Outcome(errors, notes)


def _wire(seed: int) -> Outcome:
    scene = hard_case("wire")
    transient = render(scene, EDGES, seed=seed)
    expected = oracles.upright_wire(
        scene, distance_m=scenes.WIRE_M, x_m=scenes.WIRE_X_M, radius_m=scenes.WIRE_RADIUS_M, albedo=0.8
    )
    bare = oracles.plane_moments(scene, distance_m=scenes.WALL_M, tilt_deg=0, albedo=scenes.ALBEDO)
    front = centre_path_m(transient) < scenes.WIRE_M + scenes.WALL_M
    on_wire, on_wall = moments_of(transient, front), moments_of(transient, ~front)
    by_row = on_wire.total.sum(axis=1)
    path = np.nansum(on_wire.total * np.nan_to_num(on_wire.mean_m), axis=1) / np.maximum(by_row, 1e-300)
    column = int(scene.camera.width / 2 + scene.camera.focal_px * scenes.WIRE_X_M / scenes.WIRE_M)
    dimmed = 1 - on_wall.total[:, column] / bare.total[:, column]
    # the wire, of a round profile, shines from its middle, but hides the wall to its edges: known to half a finest cell
    half_cell = 0.5 / MAX_CELLS / expected.coverage_px
    errors = {
        "energy of a row": Measured(worst(by_row, expected.radiance), 0.02),
        "energy": Measured(relative(by_row.sum(), expected.radiance.sum()), 0.02),
        "path [m]": Measured(farthest_m(path, expected.mean_path_m), 5e-4),
        "wall hidden": Measured(worst(dimmed, np.full(len(dimmed), expected.coverage_px)), half_cell),
    }
    return Outcome(errors, clipped(transient))


def _baseline_shadow(seed: int) -> Outcome:
    scene = hard_case("baseline")
    transient = render(scene, EDGES, seed=seed)
    expected = oracles.shadowed_wall(
        scene,
        wall_m=scenes.BASELINE_WALL_M,
        post_m=scenes.POST_M,
        post_x_m=scenes.POST_X_M,
        albedo=scenes.ALBEDO,
        post_albedo=0.8,
    )
    got = moments_of(transient)
    edge = expected.shadow > 0
    edge[:, expected.columns] = True
    dark = expected.shadow > 1 - 1e-9
    off = np.abs(got.total - expected.seen.total) / expected.brightest
    errors = {
        "energy off edges": Measured(worst(got.total[~edge], expected.seen.total[~edge]), CELL_ENERGY),
        "path off edges [m]": Measured(farthest_m(got.mean_m[~edge], expected.seen.mean_m[~edge]), 2e-5),
        "spread off edges": Measured(worst(got.deviation_m[~edge], expected.seen.deviation_m[~edge]), 2e-3),
        "light in the shadow": Measured(float((got.total[dark] / expected.bare[dark]).max()), 0),
        # an upright edge is known to half of one of 16 columns of cells, and the quadrature to half of one of 48
        "energy at edges, of the brighter side": Measured(float(off[edge].max()), 1 / 32 + 1 / 96),
    }
    return Outcome(errors, clipped(transient))


def _million(seed: int) -> Outcome:
    scene = hard_case("million")
    transient = render(scene, SMOOTH, seed=seed)
    plain = render(
        replace(scene, surfaces=(oracles.wall(scenes.WALL_M, scenes.ALBEDO, half_size_m=2),)), SMOOTH, seed=seed
    )
    expected = oracles.plane_moments(scene, distance_m=scenes.WALL_M, tilt_deg=0, albedo=scenes.ALBEDO)
    got, clean = moments_of(transient), moments_of(plain)
    errors = {
        "energy": Measured(worst(got.total, expected.total), CELL_ENERGY),
        "energy against two triangles": Measured(worst(got.total, clean.total), 1e-5),
        "path against two triangles [m]": Measured(farthest_m(got.mean_m, clean.mean_m), 8 * FLOAT32 * scenes.WALL_M),
        "mixed pixels [1]": Measured(int(transient.mixed.sum()), 0),
    }
    return Outcome(errors, clipped(transient))


def _inverse_square(seed: int) -> Outcome:
    distances = (0.3, 1.0, 3.0, 14.0)
    renders = [render(scenes.plane(d), SMOOTH, seed=seed) for d in distances]
    scaled = np.array([t.total_radiance().sum() * d**2 for t, d in zip(renders, distances, strict=True)])
    return Outcome({"energy times d^2": Measured(float(np.ptp(scaled) / scaled.mean()), 4e-6)}, clipped(*renders))


def _linear_in_albedo(seed: int) -> Outcome:
    albedos = (0.001, 0.5, 1.0)
    renders = [render(scenes.plane(scenes.WALL_M, albedo=a), SMOOTH, seed=seed) for a in albedos]
    scaled = np.array([t.total_radiance().sum() / a for t, a in zip(renders, albedos, strict=True)])
    return Outcome({"energy over albedo": Measured(float(np.ptp(scaled) / scaled.mean()), 4e-6)}, clipped(*renders))


def _nothing(seed: int) -> Outcome:
    transient = render(hard_case("nothing"), seed=seed)
    sky = render(hard_case("sky"), seed=seed)
    errors = {
        "returns [1]": Measured(transient.returns + sky.returns, 0),
        "depths [1]": Measured(int(np.isfinite(transient.depth_m).sum() + np.isfinite(sky.depth_m).sum()), 0),
        "radiance of the sky": Measured(worst(sky.ambient.astype(float), np.full(sky.ambient.shape, 0.7)), 1e-6),
    }
    return Outcome(errors, clipped(transient, sky))


PLANE = "closed form of a frontal Lambertian plane, integrated over each pixel in float64"
GRAZING = "closed form of the tilted plane, integrated over each pixel in float64"
CASES = (
    # the path within a cell is taken as linear: off by d (0.0096)^2 / 12 at most
    Case("near-5cm", PLANE, partial(_frontal, "near", 0.05, 1e-6)),
    Case("far-14.90m", f"{PLANE}; its counts by the pulse's integral", partial(_on_sensor, "far", 14.90)),
    Case(
        "wraps-14.995m", f"{PLANE}; its counts by the pulse's integral, wrapped", partial(_on_sensor, "wraps", 14.995)
    ),
    # float32 resolves 0.06 mm at 1 km
    Case("path-1km", PLANE, partial(_frontal, "kilometre", 500.0, 1.3e-4)),
    Case("grazing-80", GRAZING, partial(_grazing, 80)),
    Case("grazing-89", GRAZING, partial(_grazing, 89)),
    Case("grazing-89.9", GRAZING, partial(_grazing, 89.9)),
    Case("grazing-horizon", "the bounded plane on 128 x 128 rays a pixel", _horizon),
    Case("sphere-silhouette", "the true sphere on 192 x 192 rays a limb pixel", _silhouette),
    Case("glint", "GGX's closed form over a ball of steel on 512 x 512 rays a pixel", _glint),
    Case("wire", "closed form of a thin round wire along its length; the wall dimmed by its coverage", _wire),
    Case(
        "baseline-shadow",
        "closed form of a wall and a post under a displaced laser, 48 x 48 rays a pixel",
        _baseline_shadow,
    ),
    Case("million-triangles", f"{PLANE}; the same wall of two triangles", _million),
    Case("inverse-square", "L d^2 is the same from 0.3 to 14 m", _inverse_square),
    Case("linear-in-albedo", "L / albedo is the same from 0.001 to 1", _linear_in_albedo),
    Case("nothing-in-view", "no return, no depth; a constant sky as it is", _nothing),
)
