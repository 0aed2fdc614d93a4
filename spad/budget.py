"""Radiometric photon budget: from joules and lenses to detections.

Expected signal detections of a pixel = pulse energy x sum(radiance) x aperture area x pixel solid angle x transmission
x PDE x wavelength / (h c) x cycles; background = ambient spectral radiance x filter width x the same x exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require
from spad.flux import detector_maps
from spad.sensor import PhotonBudget, Sensor

PLANCK_J_S = 6.62607015e-34
BOLTZMANN_J_PER_K = 1.380649e-23
SUN_TEMPERATURE_K = 5778.0
# Luminous efficacy of radiation at 555 nm, where the eye is most sensitive.
PEAK_EFFICACY_LM_PER_W = 683.0
# Mean ambient radiance [W/(m^2 sr nm)] above which it is no radiance of daylight. White paper facing the sun: 100 klux
# are 0.82 W/(m^2 nm) at 850 nm as a black body (`sunlight_w_per_m2_nm`), the direct sun of the reference spectrum ASTM
# G-173 about 0.9, and / pi is 0.26 to 0.29; bright haze and sunlit clouds are about as bright. Silicon SPADs see most
# of the sun, 1.6 W/(m^2 nm) outside the atmosphere, near 500 nm: 0.5.
BRIGHT_SKY_W_PER_M2_SR_NM = 0.5


@dataclass(frozen=True)
class Optics:
    """The lens, the filter and the laser's pulses.

    pulse_energy_j    energy of one laser pulse, over the whole cone
    focal_length_m, f_number    aperture diameter = focal length / f-number
    pixel_pitch_m     side of a pixel's active square (fill factor included)
    transmission      of lens and filter at the laser's wavelength
    filter_nm         width of the band that the filter lets through
    wavelength_m      of the laser
    """

    pulse_energy_j: float
    focal_length_m: float
    f_number: float
    pixel_pitch_m: float
    transmission: float = 1.0
    filter_nm: float = 10.0
    wavelength_m: float = 850e-9

    def __post_init__(self) -> None:
        for name in ("pulse_energy_j", "focal_length_m", "f_number", "pixel_pitch_m", "filter_nm", "wavelength_m"):
            value = getattr(self, name)
            good = math.isfinite(value) and (value > 0 or (name == "pulse_energy_j" and value == 0))
            require(good, f"optics: {name} {value:g} must be finite and above 0")
        require(0 < self.transmission <= 1, f"optics: transmission {self.transmission:g} is outside (0, 1]")

    @property
    def aperture_m2(self) -> float:
        """Area of the lens opening."""
        return math.pi / 4 * (self.focal_length_m / self.f_number) ** 2

    @property
    def pixel_sr(self) -> float:
        """Solid angle that a pixel on the axis sees, (pitch / focal length)^2."""
        return (self.pixel_pitch_m / self.focal_length_m) ** 2

    @property
    def photons_per_joule(self) -> float:
        """wavelength / (h c)."""
        return self.wavelength_m / (PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S)

    def detections_per_radiance(self, sensor: Sensor) -> float:
        """Primary detections of a pixel per J/(m^2 sr) that comes to it: A Omega transmission PDE lambda / (h c)."""
        return self.aperture_m2 * self.pixel_sr * self.transmission * sensor.pde * self.photons_per_joule

    def signal_scale(self, sensor: Sensor) -> float:
        """Expected signal detections per exposure and unit of a transient's radiance (which is per joule emitted)."""
        return self.pulse_energy_j * self.detections_per_radiance(sensor) * sensor.cycles

    def budget(
        self, transient: Transient, sensor: Sensor, *, seed: int = 0, dark_map_hz: np.ndarray | None = None
    ) -> PhotonBudget:
        """Mean signal and mean background of a scene: the budget by means that gives these very expected counts.

        Background is ambient light through the filter and dark counts, the sensor's or a measured map's. Raises
        InputError where the mean ambient radiance is above a bright sky's: then a scene file's lights are in units of
        their own, as those made for pictures are.
        """
        pixels = transient.height * transient.width
        radiance = float(transient.ambient.mean(dtype=np.float64))
        require(
            radiance <= BRIGHT_SKY_W_PER_M2_SR_NM,
            f"ambient radiance of {radiance:.3g} W/(m2 sr nm) on average is above {BRIGHT_SKY_W_PER_M2_SR_NM:g}, a "
            "bright sky's: the scene's lights are in other units; scale them in the scene, or state the photons by "
            "--signal and --background instead of --radiometric",
        )
        signal = self.signal_scale(sensor) * float(transient.radiance.sum(dtype=np.float64)) / pixels
        ambient = radiance * self.filter_nm * sensor.exposure_s
        dark_hz, _ = detector_maps(sensor, (transient.height, transient.width), dark_map_hz, seed)
        dark = float(dark_hz.mean()) * sensor.exposure_s
        return PhotonBudget(signal, ambient * self.detections_per_radiance(sensor) + dark)


def planck_w_per_m2_nm(wavelength_m: np.ndarray | float, temperature_k: float = SUN_TEMPERATURE_K) -> np.ndarray:
    """Spectral exitance of a black body [W/(m^2 nm)], 2 pi h c^2 / lambda^5 / (exp(h c / (lambda k T)) - 1)."""
    wavelength = np.asarray(wavelength_m, dtype=np.float64)
    energy = PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S / (wavelength * BOLTZMANN_J_PER_K * temperature_k)
    exitance = 2 * math.pi * PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S**2 / wavelength**5 / np.expm1(energy)
    return exitance * 1e-9


def photopic(wavelength_m: np.ndarray) -> np.ndarray:
    """CIE 1931 luminous efficiency V(lambda), 0 to 1, by the two-lobe fit of Wyman, Sloan and Shirley (2013)."""
    nm = np.asarray(wavelength_m, dtype=np.float64) * 1e9
    return 0.821 * _lobe(nm, 568.8, 46.9, 40.5) + 0.286 * _lobe(nm, 530.9, 16.3, 31.1)


def _lobe(nm: np.ndarray, centre: float, left: float, right: float) -> np.ndarray:
    return np.exp(-0.5 * ((nm - centre) / np.where(nm < centre, left, right)) ** 2)


def sunlight_w_per_m2_nm(illuminance_lux: float, wavelength_m: float) -> float:
    """Spectral irradiance of sunlight of a given illuminance [W/(m^2 nm)]: the sun as a black body of 5778 K.

    E(lambda) = illuminance M(lambda) / (683 lm/W x integral of V M). The black body knows nothing of the atmosphere's
    absorption bands: there the real sunlight is weaker.
    """
    grid = np.arange(360e-9, 830e-9, 1e-9)
    luminous = PEAK_EFFICACY_LM_PER_W * float((photopic(grid) * planck_w_per_m2_nm(grid)).sum())
    return illuminance_lux * float(planck_w_per_m2_nm(wavelength_m)) / luminous
