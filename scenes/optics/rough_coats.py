"""Compute how much light a rough dielectric interface reflects and lets through, and what that leaves of a base.

One scattering by microfacets with Smith's shadowing (Walter et al. 2007), as in Mitsuba's rough plastic.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

# Points of quadrature: heights of microfacets, turns about the normal, angles of incidence
RADII, TURNS, COSINES = 64, 32, 256
SMOOTH = 1e-3  # alpha below which an interface is taken as smooth


def fresnel_reflectance(cosine: np.ndarray, index: float) -> np.ndarray:
    """Return the unpolarised reflectance at a smooth interface, `index` being the far side's over the near side's."""
    inside2 = 1 - (1 - cosine**2) / index**2
    inside = np.sqrt(np.maximum(inside2, 0))
    across = (cosine - index * inside) / np.maximum(cosine + index * inside, 1e-12)
    parallel = (index * cosine - inside) / np.maximum(index * cosine + inside, 1e-12)
    return np.where(inside2 <= 0, 1.0, (across**2 + parallel**2) / 2)


@lru_cache(maxsize=64)
def _base_shares(index: float, alpha: float, distribution: str) -> tuple[float, float, float]:
    """Return what a coat of that index lets through at normal incidence and at 45 degrees, and its diffuse internal
    reflectance."""
    square = (np.arange(COSINES) + 0.5) / COSINES  # of cosines, in which diffuse light is even
    inner = [_shares(math.sqrt(one), 1 / index, alpha, distribution)[0] for one in square]
    straight, slanted = (_shares(one, index, alpha, distribution)[1] for one in (1.0, math.sqrt(0.5)))
    return straight, slanted, float(np.mean(inner))


def _shares(cosine: float, index: float, alpha: float, distribution: str) -> tuple[float, float]:
    """Compute the reflectance and transmittance at an angle of incidence."""
    if alpha < SMOOTH:
        smooth = float(fresnel_reflectance(np.array(cosine), index))
        return smooth, 1 - smooth
    level = (np.arange(RADII) + 0.5) / RADII  # of equal shares of projected microfacets
    tan2 = alpha**2 * (level / (1 - level) if distribution == "ggx" else -np.log1p(-level))
    height = 1 / np.sqrt(1 + tan2)[:, None]
    turn = 2 * np.pi * (np.arange(TURNS) + 0.5) / TURNS
    sine = np.sqrt(1 - height**2)
    towards = sine * np.cos(turn) * math.sqrt(1 - cosine**2) + height * cosine
    seen = np.maximum(towards, 0)
    fresnel = fresnel_reflectance(seen, index)
    reflected = 2 * seen * height - cosine
    bent = np.sqrt(np.maximum(1 - (1 - seen**2) / index**2, 0))
    refracted = cosine / index - (seen / index - bent) * height
    facets = seen / (cosine * height) * _unshadowed(np.array(cosine), alpha, distribution)
    back, through = (
        facets * np.where(out > 0, _unshadowed(np.clip(out, 1e-9, 1), alpha, distribution), 0)
        for out in (reflected, refracted)
    )
    return float((back * fresnel).mean()), float((through * (1 - fresnel)).mean())


def _unshadowed(cosine: np.ndarray, alpha: float, distribution: str) -> np.ndarray:
    """Compute Smith's share of microfacets that are in the light, or seen, at an angle."""
    tan2 = 1 / np.square(cosine) - 1
    if distribution == "ggx":
        return 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
    slope = 1 / np.maximum(alpha * np.sqrt(tan2), 1e-9)
    fit = (3.535 * slope + 2.181 * slope**2) / (1 + 2.276 * slope + 2.577 * slope**2)  # Walter et al. 2007, (27)
    return np.where(slope < 1.6, fit, 1.0)


def with_inner_scattering(albedo: np.ndarray, index: float, alpha: float, distribution: str) -> np.ndarray:
    """Return the albedo whose base below a coat is as bright as one of `albedo` whose light, thrown back by the coat
    from inside, meets it again and again: A (1 - F) / (1 - A F), F the coat's diffuse internal reflectance."""
    inner = _base_shares(index, alpha, distribution)[2]
    return albedo * (1 - inner) / (1 - albedo * inner)


def uncoated(albedo: float, index: float, alpha: float) -> tuple[bool, float]:
    """Find what is nearest to a matte base that a coat of GGX microfacets takes no light from, in light that comes back
    to where it came from at normal incidence and at 45 degrees.

    Return whether it is a coated surface, and its albedo; otherwise it is a matte one.
    """
    lit, coat = _base_reflectance(index, alpha), _coat_reflectance(index, alpha)
    wanted = albedo + coat
    base = albedo / math.sqrt(lit.prod())
    matte = min(math.sqrt(wanted.prod()), 1.0)
    coated_off, matte_off = (
        float(np.abs(made / wanted - 1).max()) for made in (min(base, 1.0) * lit + coat, np.full(2, matte))
    )
    return (True, base) if coated_off <= matte_off else (False, matte)


def _base_reflectance(index: float, alpha: float) -> np.ndarray:
    """Compute how many times its albedo a dark base below a coat reflects to where light comes from."""
    straight, slanted, inner = _base_shares(index, alpha, "ggx")
    within = (1 - inner) * index**2
    return np.array([straight**2, slanted**2]) / within


def _coat_reflectance(index: float, alpha: float) -> np.ndarray:
    """Compute pi times what a coat reflects to where light comes from, at normal incidence and at 45 degrees."""
    fresnel = float(fresnel_reflectance(np.array(1.0), index))
    cosine = np.array([1.0, math.sqrt(0.5)])
    peak = (alpha / ((alpha**2 - 1) * cosine**2 + 1)) ** 2
    return fresnel * peak * _unshadowed(cosine, alpha, "ggx") ** 2 / (4 * cosine**2)
