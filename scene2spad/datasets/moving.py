"""A scene moved away before it is rendered: what an offset in space needs to know of the image is looked up here."""

from __future__ import annotations

import numpy as np

from render.direct.integrator import centre_layers
from render.scene.traced_scene import TracedScene
from scenes.errors import InputError, require
from scenes.model import Scene
from scenes.offsets import moved_away, pushed_along_rays


def moved(scene: Scene, metres: float, mode: str) -> Scene:
    """Return the scene `metres` away by `ray` or `rigid` (`time` is a delay of what is rendered:
    `Transient.delayed`)."""
    if mode == "ray":
        return pushed_along_rays(scene, metres)
    if mode != "rigid":
        raise InputError(f"offset mode {mode!r}, expected ray or rigid for a scene in space")
    depth = centre_layers(TracedScene(scene)).depth_m.reshape(-1).astype(np.float64)
    axial = depth * (scene.camera.rays() @ scene.camera.rotation)[..., 2].ravel()
    axial = axial[np.isfinite(axial)]
    require(axial.size > 0, f"scene {scene.name}: nothing in view, a rigid offset has no median depth to match")
    return moved_away(scene, metres, median_m=float(np.median(axial)), nearest_m=float(axial.min()))
