"""Radiometric photon budget: from joules and lenses to detections.

Expected signal detections of a pixel = pulse energy x sum(radiance) x aperture area x pixel solid angle x transmission
x PDE x wavelength / (h c) x cycles; background = ambient spectral radiance x filter width x the same x exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from render.transient import Transient
from scenes.constants import DEFAULT_WAVELENGTH_M, SPEED_OF_LIGHT_M_PER_S
from scenes.errors import normalise_fields, require, require_kind
from scenes.optics.blackbody import PLANCK_J_S
from spad.sensor.model import PhotonBudget, Sensor, detector_maps

# Mean ambient radiance [W/(m^2 sr nm)] above which it is no radiance of daylight. White paper facing the sun: 100 klux
# are 0.82 W/(m^2 nm) at 850 nm as a black body (`sunlight_w_per_m2_nm`), the direct sun of the reference spectrum ASTM
# G-173 about 0.9, and / pi is 0.26 to 0.29; bright haze and sunlit clouds are about as bright. Silicon SPADs see most
# of the sun, 1.6 W/(m^2 nm) outside the atmosphere, near 500 nm: 0.5.
BRIGHT_SKY_W_PER_M2_SR_NM = 0.5
MIN_OPTICS, MAX_OPTICS = 1e-12, 1e12  # of any length, energy and f-number: their squares stay finite
WAVELENGTHS_M = (1e-7, 1e-4)  # of light that is timed: 850 nm is 8.5e-7


@dataclass(frozen=True)
class Optics:
    """The lens, the filter and the laser's pulses.

    pulse_energy_j    energy of one laser pulse, over the whole cone; 0: the laser is off
    focal_length_m, f_number    aperture diameter = focal length / f-number
    pixel_pitch_m     from pixel to pixel; how much of that square is active is part of the sensor's `pde`
    transmission      of lens and filter at the laser's wavelength
    filter_nm         width of the band that the filter lets through
    wavelength_m      of the laser

    Raises InputError for values outside 1e-12 to 1e12, a pulse energy below 0, a transmission outside (0, 1], and a
    wavelength outside 0.1 to 100 micrometres.

    Examples
    --------
    A lens of 10 mm at f/2 is 5 mm wide. Twice the pulse energy gives twice the signal:

    >>> import scene2spad as s2s
    >>> lens = {"focal_length_m": 10e-3, "f_number": 2.0, "pixel_pitch_m": 20e-6}
    >>> optics = s2s.Optics(pulse_energy_j=1e-9, **lens)
    >>> round(1e6 * optics.aperture_m2, 2), round(1e6 * optics.pixel_sr, 2)  # mm^2, millionths of 1 sr
    (19.63, 4.0)
    >>> transient = s2s.render("plane", width=4, height=3, bounces=1)
    >>> one, two = (s2s.sense(transient, optics=s2s.Optics(energy_j, **lens)).budget for energy_j in (1e-9, 2e-9))
    >>> round(two.signal / one.signal, 6)
    2.0
    """

    pulse_energy_j: float
    focal_length_m: float
    f_number: float
    pixel_pitch_m: float
    transmission: float = 1.0
    filter_nm: float = 10.0
    wavelength_m: float = DEFAULT_WAVELENGTH_M

    def __post_init__(self) -> None:
        normalise_fields(self, "optics")
        for name in ("pulse_energy_j", "focal_length_m", "f_number", "pixel_pitch_m", "filter_nm", "wavelength_m"):
            value = getattr(self, name)
            least = 0.0 if name == "pulse_energy_j" else MIN_OPTICS  # a laser may be off: background alone
            limit = f"optics: {name} {value:g} is outside {least:g} to {MAX_OPTICS:g}"
            require(least <= value <= MAX_OPTICS, limit)
        lowest, highest = WAVELENGTHS_M
        outside = f"optics: wavelength_m {self.wavelength_m:g} is outside {lowest:g} to {highest:g}"
        require(lowest <= self.wavelength_m <= highest, outside)
        require(0 < self.transmission <= 1, f"optics: transmission {self.transmission:g} is outside (0, 1]")

    @property
    def aperture_m2(self) -> float:
        """Compute the area of the lens opening [m^2]."""
        return math.pi / 4 * (self.focal_length_m / self.f_number) ** 2

    @property
    def pixel_sr(self) -> float:
        """Compute the solid angle that a pixel on the axis sees [sr], (pitch / focal length)^2.

        Every pixel gets it, and the whole aperture: the cos^4 by which a real lens dims the others is left out.
        """
        return (self.pixel_pitch_m / self.focal_length_m) ** 2

    @property
    def photons_per_joule(self) -> float:
        """Compute the photons per joule of laser light, wavelength / (h c)."""
        return self.wavelength_m / (PLANCK_J_S * SPEED_OF_LIGHT_M_PER_S)

    def detections_per_radiance(self, sensor: Sensor) -> float:
        """Return primary detections of a pixel per J/(m^2 sr) that comes to it: A Omega transmission PDE lambda / (h
        c)."""
        return self.aperture_m2 * self.pixel_sr * self.transmission * sensor.pde * self.photons_per_joule

    def signal_scale(self, sensor: Sensor) -> float:
        """Return expected signal detections per exposure and unit of a transient's radiance (which is per joule
        emitted)."""
        return self.pulse_energy_j * self.detections_per_radiance(sensor) * sensor.cycles

    def budget(
        self, transient: Transient, sensor: Sensor, *, seed: int = 0, dark_map_hz: np.ndarray | None = None
    ) -> PhotonBudget:
        """Return mean signal and mean background of a scene: the budget by means that gives these very expected counts.

        Background is ambient light through the filter and dark counts, the sensor's or a measured map's (H, W). Raises
        InputError for a sensor's name in place of the sensor (`sensor_by_name`), and where the mean ambient radiance is
        above a bright sky's: then a scene file's lights are in units of their own, as those made for pictures are.
        """
        require_kind(transient, Transient, "budget", " of `render` or `read_transient`")
        require_kind(sensor, Sensor, "budget: sensor", " (`sensor_by_name` gives a preset)")
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
