"""Arrays checked on their way into a scene: numbers, triangles' vertices, poses."""

from __future__ import annotations

import math

import numpy as np

from scenes.errors import InputError, require

MIN_NORMAL = 1e-15  # length; float32, in which rays are traced, holds its square

# Spectral radiance [W/(m^2 sr nm)]: the sun's disk has 1e4; what lies far above is no light, and overflows in float32.
MAX_RADIANCE = 1e9


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the cross product of two vectors; numpy's takes longer to see that there are two."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def number_array(value: object, dtype: type, what: str) -> np.ndarray:
    """Copy numbers into an array of `dtype`, or an InputError: text, complex numbers, and fractions where whole numbers
    are expected are refused."""
    try:
        found = np.asarray(value)
        whole_expected = np.issubdtype(dtype, np.integer)
        if found.dtype.kind not in ("iufO" if whole_expected else "biufO"):
            raise TypeError(f"its values are {found.dtype.name}")
        if whole_expected and found.dtype.kind in "fO":
            whole = found.astype(np.float64)
            broken = whole[np.floor(whole) != whole]
            require(broken.size == 0, f"{what}: {broken[:1].sum():g} is not a whole number")
        return np.array(found, dtype=dtype, order="C")
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what}: not an array of numbers ({error})") from None


def frozen_array(value: object, dtype: type, shape_tail: tuple[int, ...], what: str) -> np.ndarray:
    """Return `value` as a read-only array of `dtype` whose trailing dimensions are `shape_tail`, or an InputError.

    A read-only array that owns its memory is kept as it is: copies of big meshes were most of a room's time.
    """
    array = value if isinstance(value, np.ndarray) else None
    sound = array is not None and array.dtype == dtype and array.base is None
    if array is None or not sound or array.flags.writeable or not array.flags.c_contiguous:
        array = number_array(value, dtype, what)
    tail = array.shape[array.ndim - len(shape_tail) :] if array.ndim >= len(shape_tail) else None
    require(tail == shape_tail, f"{what}: shape {array.shape}, expected (..., {', '.join(map(str, shape_tail))})")
    array.setflags(write=False)
    return array


def check_faces(faces: np.ndarray, vertices: int, where: str) -> None:
    """Raise InputError if a face refers to a vertex that is not there."""
    worst = faces.min() if faces.min() < 0 else faces.max()
    require(0 <= worst < vertices, f"{where}: a face refers to vertex {worst}, expected 0 to {vertices - 1}")


def mesh_arrays(vertices: object, faces: object, farthest_m: float, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m] (n, 3) and faces (m, 3) as read-only arrays, or an InputError for a mesh that does not hold
    together."""
    points = frozen_array(vertices, np.float64, (3,), f"{where}: vertices")
    corners = frozen_array(faces, np.int64, (3,), f"{where}: faces")
    require(points.ndim == 2 and corners.ndim == 2, f"{where}: vertices and faces must be tables of three columns")
    require(len(corners) > 0 and len(points) > 0, f"{where}: has no faces")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise InputError(f"{where}: {bad} of {len(points)} vertices are NaN or infinite")
    farthest = float(np.abs(points).max())
    require(farthest <= farthest_m, f"{where}: a vertex at {farthest:g} m is beyond {farthest_m:g} m")
    check_faces(corners, len(points), where)
    return points, corners


def vertex_array(value: object, width: int, vertices: int, label: str, where: str) -> np.ndarray:
    """Return `width` numbers for each of `vertices` as a read-only array, or an InputError; `label` says what they
    are."""
    array = frozen_array(value, np.float64, (width,), f"{where}: {label}")
    require(len(array) == vertices, f"{where}: {len(array)} {label} for {vertices} vertices")
    require(bool(np.isfinite(array).all()), f"{where}: {label} hold NaN or infinite values")
    return array


def check_normals(normals: np.ndarray, faces: np.ndarray, where: str) -> None:
    """Raise InputError if a vertex of a face has a normal without a direction, by which its surface is black."""
    short = np.einsum("ij,ij->i", normals, normals) < MIN_NORMAL**2
    if short.any() and short[faces].any():
        vertex, count = faces[short[faces]][0], np.count_nonzero(short)
        length = np.linalg.norm(normals[vertex])
        raise InputError(
            f"{where}: {count} of {len(normals)} normals have no length, that of vertex {vertex} {length:g}"
        )


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


def looking_pose(origin: object, target: object, up: object) -> np.ndarray:
    """Return the pose (4, 4), camera to world, at `origin` [m] that looks at `target` [m], `up` upwards in the image.

    Raises InputError where these are not three finite numbers each, or do not say a direction.
    """
    labels = ("camera position", "point to look at", "up direction")
    start, end, upwards = (np.array(three_numbers(v, n)) for v, n in zip((origin, target, up), labels, strict=True))
    forward = end - start
    right = cross(forward, upwards)
    far_enough = np.linalg.norm(forward) > 1e-9 and np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward)
    message = f"camera at {start.tolist()} cannot look at {end.tolist()} with up {upwards.tolist()}"
    require(bool(far_enough), message)
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack((right, cross(forward, right), forward, start))
    return pose


def finite_number(value: object, what: str) -> float:
    """Return `value` as a finite float, or an InputError: truth values, text and complex numbers are none."""
    real = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    try:
        number = float(value) if real else math.nan  # type: ignore[arg-type]
    except OverflowError:  # of a whole number beyond 1.8e308
        number = math.nan
    require(math.isfinite(number), f"{what} {value!r} is not a finite number")
    return number


def three_numbers(value: object, what: str, most: float = math.inf) -> tuple[float, float, float]:
    """Return a point or a direction as three floats of magnitude `most` or less, or an InputError."""
    try:
        x, y, z = (finite_number(number, what) for number in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError):  # of which InputError is one
        raise InputError(f"{what} {value!r} is not three finite numbers") from None
    require(max(abs(x), abs(y), abs(z)) <= most, f"{what} {value!r} is outside {-most:g} to {most:g} in a coordinate")
    return x, y, z


def whole_pixels(value: object, most: int, what: str) -> int:
    """Return a side of an image, 1 to `most` pixels, or an InputError."""
    side = finite_number(value, what)
    require(side == int(side) and 1 <= side <= most, f"{what} {side:g} is outside 1 to {most} whole pixels")
    return int(side)


def checked_radiance(value: object, what: str) -> float:
    """Return `value` as a radiance, 0 to MAX_RADIANCE."""
    number = finite_number(value, what)
    require(number >= 0, f"{what} {number:g} is negative")
    require(number <= MAX_RADIANCE, f"{what} {number:g} is above {MAX_RADIANCE:g} W/(m2 sr nm), no light is so bright")
    return number
