"""Arrays checked on their way into a scene: numbers, triangles' vertices, poses."""

from __future__ import annotations

import math

import numpy as np

from scenes.errors import InputError, require

# Spectral radiance [W/(m^2 sr nm)]: the sun's disk has 1e4; what lies far above is no light, and overflows in float32.
MAX_RADIANCE = 1e9


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the cross product of two vectors; numpy's takes longer to see that there are two."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def frozen_array(value: object, dtype: type, shape_tail: tuple[int, ...], what: str) -> np.ndarray:
    """Return `value` as a read-only array of `dtype` whose trailing dimensions are `shape_tail`, or an InputError.

    A read-only array that owns its memory is kept as it is: copies of big meshes were most of a room's time.
    """
    array = value if isinstance(value, np.ndarray) else None
    sound = array is not None and array.dtype == dtype and array.base is None
    if array is None or not sound or array.flags.writeable or not array.flags.c_contiguous:
        try:
            array = np.array(value, dtype=dtype, order="C")
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{what}: not an array of numbers ({error})") from None
    tail = array.shape[array.ndim - len(shape_tail) :] if array.ndim >= len(shape_tail) else None
    require(tail == shape_tail, f"{what}: shape {array.shape}, expected (..., {', '.join(map(str, shape_tail))})")
    array.setflags(write=False)
    return array


def check_faces(faces: np.ndarray, vertices: int, where: str) -> None:
    """Raise InputError if a face refers to a vertex that is not there."""
    worst = faces.min() if faces.min() < 0 else faces.max()
    require(0 <= worst < vertices, f"{where}: a face refers to vertex {worst}, expected 0 to {vertices - 1}")


def rigid_pose(value: object, what: str) -> np.ndarray:
    """Return `value` as a read-only 4x4 rotation and translation (camera or environment to world); a reflection is
    refused."""
    pose = frozen_array(value, np.float64, (4, 4), what)
    require(pose.ndim == 2 and bool(np.isfinite(pose).all()), f"{what}: needs 4x4 finite numbers")
    rotation = pose[:3, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-5 and np.linalg.det(rotation) > 0
    require(bool(orthonormal), f"{what}: the upper 3x3 block is not a rotation")
    last_row = np.abs(pose[3] - (0, 0, 0, 1)).max() <= 1e-6
    require(bool(last_row), f"{what}: the last row is {pose[3].tolist()}, expected 0 0 0 1")
    return pose


def finite_number(value: object, what: str) -> float:
    """Return `value` as a finite float, or an InputError."""
    if not isinstance(value, (int, float, np.number)) or not math.isfinite(value):
        raise InputError(f"{what} {value!r} is not a finite number")
    return float(value)


def checked_radiance(value: object, what: str) -> float:
    """Return `value` as a radiance, 0 to MAX_RADIANCE."""
    number = finite_number(value, what)
    require(number >= 0, f"{what} {number:g} is negative")
    require(number <= MAX_RADIANCE, f"{what} {number:g} is above {MAX_RADIANCE:g} W/(m2 sr nm), no light is so bright")
    return number
