"""Place a scene as the user asks beyond its file: its size, its upward axis, and where the camera stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from scenes.errors import require
from scenes.model import Camera, Scene

AXES = ("x", "y", "z")
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Placing:
    """State how a scene stands; None leaves it as the file or the loader has it.

    up       axis of a mesh file that points up: x, y or z
    scale    metres per unit of the file
    origin   where the camera stands [m], in the world of the loaded scene (y up)
    target   what the camera's axis meets [m]
    fov_deg  full horizontal angle of the camera
    bare     a mesh without the floor and the wall that are put around it
    """

    up: str | None = None
    scale: float | None = None
    origin: Point | None = None
    target: Point | None = None
    fov_deg: float | None = None
    bare: bool = False

    def __post_init__(self) -> None:
        require(self.up is None or self.up in AXES, f"up axis {self.up!r}, expected one of {', '.join(AXES)}")
        if self.scale is not None:
            good = math.isfinite(self.scale) and 1e-9 <= self.scale <= 1e9
            require(good, f"scale {self.scale:g} metres a unit is outside 1e-9 to 1e9")
        for name, point in (("camera position", self.origin), ("point to look at", self.target)):
            good = point is None or all(map(math.isfinite, point))
            require(good, f"{name} {point} is not three finite numbers")

    @property
    def moves_camera(self) -> bool:
        return not (self.origin is None and self.target is None and self.fov_deg is None)

    def camera(self, camera: Camera, target: np.ndarray) -> Camera:
        """Return the camera as stated, upright; `target` is what it looks at where nothing is stated.

        A camera whose target alone is stated turns where it stands. Raises InputError as `Camera.look_at` does.
        """
        if not self.moves_camera:
            return camera
        fov = camera.fov_deg if self.fov_deg is None else self.fov_deg
        if self.origin is None and self.target is None:
            return replace(camera, fov_deg=fov)
        origin = camera.origin if self.origin is None else self.origin
        aimed_at = target if self.target is None else self.target
        return Camera.look_at(origin, aimed_at, fov_deg=fov, width=camera.width, height=camera.height)


AS_IT_IS = Placing()


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
    return replace(scene, camera=placing.camera(scene.camera, middle))
