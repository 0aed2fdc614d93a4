"""Describe scenes: geometry, materials, camera, laser and ambient light. Knows nothing of any renderer.

Examples
--------
A wall of 2 m by 2 m, half dark and half bright, is built by hand and seen from 3 m away:

>>> import scene2spad as s2s
>>> paint = s2s.Material(albedo=s2s.Texture([[0.2] * 4 + [0.8] * 4], "halves"))  # one row of eight texels
>>> corners, uv = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 0], [1, 0], [1, 1], [0, 1]]  # corners in m
>>> wall = s2s.Surface(corners, [[0, 1, 2], [0, 2, 3]], paint, uv)
>>> camera = s2s.Camera.look_at((0, 0, 3), (0, 0, 0), fov_deg=30, width=4, height=3)
>>> scene = s2s.Scene("halves", (wall,), camera)
>>> transient = s2s.render(scene, bounces=1)
>>> transient.albedo[0].astype(float).round(2).tolist()
[0.2, 0.2, 0.8, 0.8]
>>> s2s.points(transient)[0, :, 2].round(3).tolist()  # z of what the first row sees [m]
[3.0, 3.0, 3.0, 3.0]

A laser 10 cm to the right of the camera lights one row at a time. Its profile [1/sr] integrates to 1 over the row:

>>> laser = s2s.Laser("line", baseline_m=(0.1, 0, 0))
>>> laser.position(camera).round(3).tolist()  # in the world [m]
[0.1, 0.0, 3.0]
>>> (laser.intensity(camera) * camera.pixel_solid_angle()).sum(axis=1).round(6).tolist()
[1.0, 1.0, 1.0]

A surface of albedo rho under a uniform sky of radiance L [W/(m^2 sr nm)] reflects rho L:

>>> grey = s2s.Surface(corners, [[0, 1, 2], [0, 2, 3]], s2s.Material(albedo=0.5))
>>> outdoors = s2s.Scene("outdoors", (grey,), camera, ambient=s2s.Ambient(radiance=0.01))
>>> s2s.render(outdoors, bounces=1).ambient[0].astype(float).round(3).tolist()  # [W/(m^2 sr nm)]
[0.005, 0.005, 0.005, 0.005]
"""

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from scenes.errors import InputError
    from scenes.model import Ambient, Camera, Laser, Material, Scene, Surface, Texture

__all__ = ["Ambient", "Camera", "InputError", "Laser", "Material", "Scene", "Surface", "Texture"]

# The command line imports this package before it can answer Ctrl-C: NumPy, of the model, comes when it is asked for.
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "scenes.errors": ("InputError",),
        "scenes.model": ("Ambient", "Camera", "Laser", "Material", "Scene", "Surface", "Texture"),
    },
)
