"""Place a scene as the user asks beyond its file: its size, its upward axis, and where the camera stands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TypedDict

import numpy as np

from scenes.arrays import finite_number, three_numbers
from scenes.errors import did_you_mean, normalise_fields, require, require_choice, require_kind
from scenes.model import Camera, Scene

AXES = ("x", "y", "z")
Point = tuple[float, float, float]
# Horizontal part of a view's direction, to its vertical one, below which it is straight down or up: what is left is
# rounding, of vertices in single precision for instance, and says nothing of where up is in the image.
VERTICAL = 1e-6


@dataclass(frozen=True)
class Placing:
    """State how a scene stands; None leaves it as the file or the loader has it.

    up       axis of a mesh file that points up: x, y or z
    scale    metres per unit of the file
    origin   where the camera stands [m], in the world of the loaded scene (y up)
    target   what the camera's axis meets [m]
    fov_deg  full horizontal angle of the camera
    bare     a mesh without the floor and the wall that are put around it

    Raises InputError that names a field of another kind, or beyond its limits, and its value.

    Examples
    --------
    The wall of the scene `plane` is 3 m in front of the origin. A camera 1 m farther back is 4 m away from it:

    >>> import scene2spad as s2s
    >>> placing = s2s.Placing(origin=(0, 0, 1), target=(0, 0, -3), fov_deg=10)
    >>> transient = s2s.render("plane", width=3, height=3, bounces=1, placing=placing)
    >>> round(float(transient.depth_m[1, 1]), 3)  # [m]
    4.0
    """

    up: str | None = None
    scale: float | None = None
    origin: Point | None = None
    target: Point | None = None
    fov_deg: float | None = None
    bare: bool = False

    def __post_init__(self) -> None:
        if self.up is not None:
            require_choice(self.up, AXES, "up axis")
        if self.scale is not None:
            scale = finite_number(self.scale, "scale [metres a unit]")
            require(1e-9 <= scale <= 1e9, f"scale {scale:g} metres a unit is outside 1e-9 to 1e9")
        if self.fov_deg is not None:
            finite_number(self.fov_deg, "camera fov")
        for name, label in (("origin", "camera position"), ("target", "point to look at")):
            point = getattr(self, name)
            if point is not None:
                object.__setattr__(self, name, three_numbers(point, label))
        normalise_fields(self, "placing")

    @property
    def moves_camera(self) -> bool:
        """Return whether position, direction or angle of the camera is stated, a bool."""
        return not (self.origin is None and self.target is None and self.fov_deg is None)

    def camera(self, camera: Camera, target: np.ndarray, notes: list[str]) -> Camera:
        """Return the camera as stated, upright; `target` (3,) [m] is what it looks at where nothing is stated.

        A camera whose target alone is stated turns where it stands. One that looks straight down or up keeps +x on the
        right of the image, as a camera at the scene's front (+z) that goes over its top or under it: -z is up in the
        image where it looks down, +z where it looks up, which `notes` are told. Raises InputError as `Camera.look_at`
        does.
        """
        if not self.moves_camera:
            return camera
        fov = camera.fov_deg if self.fov_deg is None else self.fov_deg
        if self.origin is None and self.target is None:
            return replace(camera, fov_deg=fov)
        origin = camera.origin if self.origin is None else self.origin
        aimed_at = target if self.target is None else self.target
        up = (0.0, 1.0, 0.0)
        across, upward, along = (float(end - start) for start, end in zip(origin, aimed_at, strict=True))
        if math.hypot(across, along) < VERTICAL * abs(upward):
            up = (0.0, 0.0, math.copysign(1.0, upward))
            where, sign = ("up", "+") if upward > 0 else ("down", "-")
            notes.append(f"the camera looks straight {where}: {sign}z is up in the image, +x on its right")
        return Camera.look_at(origin, aimed_at, fov_deg=fov, width=camera.width, height=camera.height, up=up)


class PlacingFields(TypedDict, total=False):
    """Fields of `Placing` as keywords of a function."""

    up: str | None
    scale: float | None
    origin: Point | None
    target: Point | None
    fov_deg: float | None
    bare: bool


AS_IT_IS = Placing()


def stated(placing: Placing, values: Mapping[str, object], where: str) -> Placing:
    """Return a placing with fields of it that were given to a function as keywords.

    Raises InputError for other keywords, which comes with `where`, the call, and what it takes, and for a field that
    both state.
    """
    require_kind(placing, Placing, f"{where}: placing", " (scenes.placing)")
    known = [item.name for item in fields(Placing)]
    for name in values:
        expected = f"expected fields of Placing: {', '.join(known)}"
        require(name in known, f"{where}: {name!r} is unknown, {expected}{did_you_mean(name, known)}")
        there = getattr(placing, name)
        twice = f"{where}: {name} is given twice, as {values[name]!r} and as {there!r} in placing"
        require(there == getattr(AS_IT_IS, name), twice)
    return replace(placing, **values)  # type: ignore[arg-type]


def scaled(scene: Scene, factor: float) -> Scene:
    """Make a scene `factor` times as large, camera and laser with it; what is seen stays the same, times change."""
    pose = scene.camera.pose.copy()
    pose[:3, 3] *= factor
    surfaces = tuple(replace(surface, vertices=surface.vertices * factor) for surface in scene.surfaces)
    right, down, forward = (factor * value for value in scene.laser.baseline_m)
    laser = replace(scene.laser, baseline_m=(right, down, forward))
    return replace(scene, surfaces=surfaces, camera=replace(scene.camera, pose=pose), laser=laser)


def placed(scene: Scene, placing: Placing) -> Scene:
    """Return a scene with its size and camera as stated. Raises InputError for what is for mesh files alone."""
    require(placing.up is None and not placing.bare, f"{scene.name}: an upward axis and `bare` are for mesh files")
    if placing.scale is not None:
        scene = scaled(scene, placing.scale)
    if not placing.moves_camera:
        return scene
    points = np.concatenate([surface.vertices for surface in scene.surfaces])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    notes = list(scene.notes)
    return replace(scene, camera=placing.camera(scene.camera, middle, notes), notes=tuple(notes))
