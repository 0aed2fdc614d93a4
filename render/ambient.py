"""Steady light of environment and area lights, by Mitsuba's own path integrator: it needs nothing of ours."""

from __future__ import annotations

import numpy as np

from render.world import World, mi


def ambient_light(world: World, spp: int, bounces: int, seed: int) -> np.ndarray:
    """Steady spectral radiance of environment and area lights at each pixel [W/(m^2 sr nm)], (H, W) float32.

    Mitsuba's own path integrator: steady light needs nothing of ours.
    """
    camera = world.scene.camera
    if world.has_cutouts:
        world = World(world.scene, cutouts_by_mitsuba=True)
    # the camera is the traced world's origin; Mitsuba's has x to the left and y up
    turned = np.eye(4)
    turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": camera.fov_deg,
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(turned),
            "near_clip": 1e-4,
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": bounces})
    image = np.array(mi.render(world.traced, sensor=sensor, integrator=integrator, spp=spp, seed=seed))
    return np.maximum(np.nan_to_num(image.reshape(camera.height, camera.width)), 0).astype(np.float32)
