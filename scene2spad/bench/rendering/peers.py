"""mitransient on our scenes: the same meshes, materials, camera and laser, and its traps avoided.

Its path length starts at the near plane, so that lies at 10 um; its pixel filter must be a box.
"""

from __future__ import annotations

import importlib.util
import math

import numpy as np

from render.backend.drjit_types import Tensors
from render.scene.traced_scene import TracedScene, dr, mi
from scenes.errors import InputError
from scenes.files import silenced
from scenes.model import Scene

INSTALL = "pip install 'scene2spad[bench]'"
NEAR_CLIP_M, FAR_CLIP_M = 1e-5, 1e4


def available() -> bool:
    return importlib.util.find_spec("mitransient") is not None


class Peer:
    """One scene as mitransient holds it, for one sampler and one number of bounces; built once, not timed.

    It takes the meshes and reflectances of our `world`, which must hold no other lights (`settings.comparable`): Dr.Jit
    compiles calls for every such object there is, so a second set of them would slow both codes down.
    """

    def __init__(self, world: TracedScene, sampler: str, bounces: int, bins: int, bin_m: float) -> None:
        with silenced():
            import mitransient  # noqa: F401  (registers its plugins with Mitsuba)
        scene = world.scene
        if not scene.laser.is_colocated or scene.laser.mode != "flood":
            raise InputError("mitransient has no line, scanning or displaced laser of ours to compare with")
        camera = scene.camera
        turned = np.eye(4)
        # our traced world has the camera at its origin; Mitsuba's camera has x to the left and y up
        turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
        pose = mi.ScalarTransform4f(turned)
        film = {
            "type": "transient_hdr_film",
            "width": camera.width,
            "height": camera.height,
            "temporal_bins": bins,
            "bin_width_opl": bin_m,
            "start_opl": 0.0,
            "rfilter": {"type": "box"},
        }
        sensor = {
            "type": "perspective",
            "fov": camera.fov_deg,
            "fov_axis": "x",
            "near_clip": NEAR_CLIP_M,
            "far_clip": FAR_CLIP_M,
            "to_world": pose,
            "sampler": {"type": sampler, "sample_count": 16},
            "film": film,
        }
        meshes = {f"mesh{i}": shape for i, shape in enumerate(world.mi_scene.shapes())}
        described = {"type": "scene", "embree_use_robust_intersections": True, "sensor": sensor, "laser": _laser(scene)}
        self.scene = mi.load_dict({**described, **meshes}, optimize=False)
        self.integrator = mi.load_dict({"type": "transient_path", "max_depth": bounces + 1})
        self.shape = (camera.height * camera.width, bins)

    def render(self, spp: int, seed: int) -> Tensors:
        """Return the evaluated tensor, (H, W, bins, 1): radiance per pixel and bin."""
        _, tensor = mi.render(self.scene, integrator=self.integrator, spp=spp, seed=seed)
        dr.eval(tensor)
        dr.sync_thread()
        return tensor

    def histogram(self, tensor: Tensors) -> np.ndarray:
        """Return the tensor's own memory as (pixels, bins) float32."""
        return np.array(tensor.array, copy=False).reshape(self.shape)


def _laser(scene: Scene) -> dict[str, object]:
    camera, laser = scene.camera, scene.laser
    intensity = {"type": "rgb", "value": float(laser.intensity(camera)[0, 0])}
    if laser.cone_deg == 360:
        return {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": intensity}
    turned = np.eye(4)
    turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
    # the corner pixels' rays lie on the rim of our smallest cone, and a spot fades between its two angles
    rim = math.degrees(math.acos(laser.cos_half_angle(camera)))
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(turned),
        "intensity": intensity,
        "cutoff_angle": rim * (1 + 1e-5),
        "beam_width": rim,
    }
