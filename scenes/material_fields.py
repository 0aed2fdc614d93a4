"""Fields of a `Material` that are on their way to one."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

if TYPE_CHECKING:
    from scenes.model import MaterialKind, MicrofacetDistribution, Texture


class MaterialFields(TypedDict, total=False):
    """Some fields of a `Material`; it checks their values."""

    kind: MaterialKind
    albedo: float | Texture
    roughness: float
    distribution: MicrofacetDistribution
    specular: float
    ior: float
    eta: float
    k: float
    opacity: float | Texture
