"""Describe scenes: geometry, materials, camera, laser and ambient light. Knows nothing of any renderer."""

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
