"""Describe scenes: geometry, materials, camera, laser and ambient light. Knows nothing of any renderer."""

from scenes.errors import InputError
from scenes.model import Ambient, Camera, Laser, Material, Scene, Surface, Texture

__all__ = ["Ambient", "Camera", "InputError", "Laser", "Material", "Scene", "Surface", "Texture"]
