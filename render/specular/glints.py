"""Glints: the laser itself seen in plane mirrors, in the smooth coat of plastic and in the faces of glass."""

from __future__ import annotations

import numpy as np

from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload
from render.specular.mirrors import LOBE_RAD, LOBE_RAYS, Mirrors, image_of, lobe_points, specular_points
from render.specular.unfolded_ways import MirrorTables, connect_to_image
from render.transient.samples import Samples, no_samples


def glints(world: TracedScene, tables: MirrorTables, mirrors: Mirrors, sequence: np.ndarray) -> Samples:
    """Find the glints of the laser itself in rows of (m, k) planes, from the camera on."""
    camera, laser = world.scene.camera, world.scene.laser
    laser_point = laser.position(camera) - camera.origin
    image = image_of(mirrors, sequence, laser_point)
    last, possible = specular_points(mirrors, sequence, image, 5 * LOBE_RAD)
    column, row = _raster(world, image)
    possible &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    possible &= _shines_on(world, last, laser_point, column, row)
    kept = np.flatnonzero(possible)
    if len(kept) == 0:
        return no_samples()
    sequence, image = sequence[kept], image[kept]
    row, column = row[kept].astype(np.int64), column[kept].astype(np.int64)
    distance = np.linalg.norm(image, axis=1)
    lanes = lobe_points(image).reshape(-1, 3)
    planes = [upload(UInt32, np.repeat(plane, LOBE_RAYS)) for plane in sequence.T]
    target = mi.Point3f(*(upload(Float, axis) for axis in (lanes + world.eye_m).T))
    start = mi.Point3f(world.eye) + dr.zeros(mi.Vector3f, len(lanes))
    active = dr.full(Bool, True, len(lanes))
    ends = start, mi.Vector3f(0), target
    weight, delay, shortening, _ = connect_to_image(world, tables, ends, planes, active, True)
    dr.eval(weight, delay, shortening)
    weight, delay, shortening = (
        np.array(value, dtype=np.float64).reshape(-1, LOBE_RAYS) for value in (weight, delay, shortening)
    )
    spread = (distance[:, None] / np.maximum(distance[:, None] - shortening, 1e-3 * distance[:, None])) ** 2
    energy = (weight * spread).mean(axis=1) * _made_up(image, weight > 0)
    lit = energy > 0
    late = (weight * delay).sum(axis=1)[lit] / weight.sum(axis=1)[lit]
    row, column, distance, energy = row[lit], column[lit], distance[lit], energy[lit]
    axial = image[lit] @ camera.rotation[:, 2] / distance
    per_pixel = laser.intensity(camera)[row, column] * camera.focal_px**2 / axial**3
    return Samples(
        row * camera.width + column,
        np.round(distance + late, 9),  # the ways through a corner cube have one length, whatever rounding says
        np.zeros(len(row)),
        energy * per_pixel / distance**2,
        np.full(len(row), sequence.shape[1], np.uint8),
    )


def _made_up(image: np.ndarray, came_back: np.ndarray) -> np.ndarray:
    """Compute the factor (m,) that makes up for the one or two rays of a lobe (m, LOBE_RAYS) lost to rounding on a
    border of faces.

    In a corner cube the ways in different order share one image and divide its lobe among them.
    """
    _, group = np.unique(np.round(image, 6), axis=0, return_inverse=True)
    group = group.reshape(-1)
    covered = np.zeros((group.max() + 1, LOBE_RAYS))
    np.add.at(covered, group, came_back)
    count = (covered > 0).sum(axis=1)[group]
    return np.where(count >= LOBE_RAYS - 2, LOBE_RAYS / np.maximum(count, 1), 1.0)


def _raster(world: TracedScene, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute column and row (floored, -1: behind the camera) of the pixels that look in the given directions (m,
    3)."""
    camera = world.scene.camera
    x, y, z = (direction @ camera.rotation).T
    ahead = z > 0
    z = np.where(ahead, z, 1)
    column, row = camera.focal_px * x / z + camera.width / 2, camera.focal_px * y / z + camera.height / 2
    # a direction along the border of two pixels belongs to the later one, whatever rounding says
    return np.where(ahead, np.floor(column + 1e-9), -1), np.where(ahead, np.floor(row + 1e-9), -1)


def _shines_on(
    world: TracedScene, point: np.ndarray, laser_point: np.ndarray, column: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Return whether the laser shines on points (m, 3) while the pixel (column, row) is measured: `in_beam` in
    float64."""
    camera, laser = world.scene.camera, world.scene.laser
    if laser.mode == "flood":
        x, y, z = ((point - laser_point) @ camera.rotation).T
        return np.arctan2(np.hypot(x, y), z) <= laser.half_angle(camera) * (1 + 1e-5)
    lit_column, lit_row = _raster(world, point)
    in_image = (lit_column >= 0) & (lit_column < camera.width)
    return (lit_row == row) & (in_image if laser.mode == "line" else lit_column == column)
