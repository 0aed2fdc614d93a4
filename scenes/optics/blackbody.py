"""Light of black bodies: Planck's law, the eye's response, and sunlight by its illuminance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S

PLANCK_J_S = 6.62607015e-34
BOLTZMANN_J_PER_K = 1.380649e-23
SUN_TEMPERATURE_K = 5778.0
# Luminous efficacy of radiation at 555 nm, where the eye is most sensitive.
PEAK_EFFICACY_LM_PER_W = 683.0
HARDLY_SEEN_NM = 0.1  # a thousandth of the eye's response, 107 nm wide


def planck_w_per_m2_nm(wavelength_m: np.ndarray | float, temperature_k: float = SUN_TEMPERATURE_K) -> np.ndarray:
    """Return spectral exitance of a black body [W/(m^2 nm)], 2 pi h c^2 / lambda^5 / (exp(h c / (lambda k T)) - 1)."""
    wavelength = np.asarray(wavelength_m, dtype=np.float64)
    energy = PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S / (wavelength * BOLTZMANN_J_PER_K * temperature_k)
    exitance = 2 * math.pi * PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S**2 / wavelength**5 / np.expm1(energy)
    return exitance * 1e-9


def photopic(wavelength_m: np.ndarray) -> np.ndarray:
    """Return CIE 1931 luminous efficiency V(lambda), 0 to 1, by the two-lobe fit of Wyman, Sloan and Shirley (2013)."""
    nm = np.asarray(wavelength_m, dtype=np.float64) * 1e9
    return 0.821 * _lobe(nm, 568.8, 46.9, 40.5) + 0.286 * _lobe(nm, 530.9, 16.3, 31.1)


def _lobe(nm: np.ndarray, centre: float, left: float, right: float) -> np.ndarray:
    return np.exp(-0.5 * ((nm - centre) / np.where(nm < centre, left, right)) ** 2)


def sunlight_w_per_m2_nm(illuminance_lux: float, wavelength_m: float) -> float:
    """Return spectral irradiance of sunlight of a given illuminance [W/(m^2 nm)]: the sun as a black body of 5778 K.

    E(lambda) = illuminance M(lambda) / (683 lm/W x integral of V M). The black body knows nothing of the atmosphere's
    absorption bands: there the real sunlight is weaker.
    """
    grid = np.arange(360e-9, 830e-9, 1e-9)
    luminous = PEAK_EFFICACY_LM_PER_W * float((photopic(grid) * planck_w_per_m2_nm(grid)).sum())
    return illuminance_lux * float(planck_w_per_m2_nm(wavelength_m)) / luminous


def sunlit_sky_w_per_m2_sr_nm(illuminance_lux: float, wavelength_m: float) -> float:
    """Return radiance of an even sky that lights an open, level surface as strongly as sunlight of that illuminance.

    E / pi, with E as in `sunlight_w_per_m2_nm`. It has the sun's strength and no shadows.
    """
    return sunlight_w_per_m2_nm(illuminance_lux, wavelength_m) / math.pi


def seen_radiance_w_per_m2_sr_nm(temperature_k: float) -> float:
    """Return spectral radiance of a black body as the eye weights it: its mean over V(lambda), 360 to 830 nm."""
    grid = np.arange(360e-9, 830e-9, 1e-9)
    return float(np.average(planck_w_per_m2_nm(grid, temperature_k), weights=photopic(grid))) / math.pi


def seen_mean(spectrum: Iterable[Sequence[float]]) -> float:
    """Return the mean of a spectrum as the eye weights it, over V(lambda): of colours, what their luminance is.

    spectrum  pairs of a wavelength [nm] and a value, which is linear between them; nothing is known beyond them

    A spectrum that the eye hardly sees, as one in the infrared, has its plain mean over wavelength.
    """
    wavelength, value = np.array(sorted(map(tuple, spectrum))).T
    seen = np.arange(360.0, 831.0)
    grid = np.union1d(wavelength, seen[(seen > wavelength[0]) & (seen < wavelength[-1])])
    with np.errstate(over="ignore"):  # of wavelengths beyond all, which are not seen
        values, weights = np.interp(grid, wavelength, value), photopic(grid * 1e-9)
    if np.trapezoid(weights, grid) < HARDLY_SEEN_NM:
        weights = np.ones_like(grid)
    whole = np.trapezoid(weights, grid)
    return float(np.trapezoid(weights * values, grid) / whole if whole > 0 else value.mean())
