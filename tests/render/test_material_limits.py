"""Materials at the ends of their parameters are other materials."""

from __future__ import annotations

import math

import numpy as np
import pytest

from render.engine import render
from render.settings import RenderSettings
from scenes import Camera, Material, Scene, Surface


def facing(material: Material, normal: np.ndarray) -> Scene:
    """A plate 2 m from the camera that reflects its light straight back, in an image of few wide pixels."""
    right = np.cross(normal, (0, 1, 0)) / np.linalg.norm(np.cross(normal, (0, 1, 0)))
    up = np.cross(normal, right)
    corners = [-2 * normal + 0.4 * (x * right + y * up) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    plate = Surface(np.array(corners), [[0, 1, 2], [0, 2, 3]], material)
    return Scene("plate", (plate,), Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=70, width=4, height=4))


@pytest.mark.parametrize("tilt_deg", [2, 8, 14, 20, 26])
def test_metal_of_hardly_any_roughness_is_as_bright_as_a_mirror(tilt_deg: float) -> None:
    """Wherever in a pixel the laser's image lies: a pixel's mean is that over its square."""
    sine = math.sin(math.radians(tilt_deg))
    normal = np.array([sine, 0.6 * sine, 1]) / math.hypot(sine, 0.6 * sine, 1)
    kinds = (Material("conductor", specular=0.9), Material("roughconductor", specular=0.9, roughness=0.003))
    settings = RenderSettings(bounces=1, grid=16)
    mirror, metal = (render(facing(kind, normal), settings).radiance.sum(dtype=float) for kind in kinds)
    assert metal == pytest.approx(mirror, rel=2e-3)
