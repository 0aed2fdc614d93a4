"""Define what `study sim-to-real` runs. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

from spad.sensor.zone_array import EFFECTS

SENSOR = "tmf8820"
# What is calibrated. Crosstalk is not: a plane that fills all zones hardly tells it from the zones' own light.
FITTED = ("delay", "skew", "clock", "bin_width", "chirp", "background", "leak", "echo", "trials", "recovery")
# A description without a law, off: what it would buy stands in the table of effects.
TRIED = ("compression",)
# Effects of the light's geometry: the plane is rendered again without them.
GEOMETRY = ("parallax", "aperture", "illumination")
FULL_BIN = 10_000  # counts from which on a bin's misfit is the model's, not the photons'
MODEL_ERROR = 0.004  # relative, of a bin: what a calibration and a pose weigh with


@dataclass(frozen=True)
class Plan:
    """Extent of the study: which captures are calibrated on, held out and shown, and which effects are switched off.

    nearest_m   captures nearer than this are predicted, but not calibrated on
    every       of the captures from there on, each that many-th is calibrated on; the others are held out
    ablated     effects that are switched off, or on, in turn
    folds       of the captures calibrated on: each effect is judged on folds that its calibration did not see
    pose_every  of the captures of either half, each that many-th gives a pose
    shown_m     distances of the first figure
    """

    nearest_m: float = 0.1
    every: int = 2
    ablated: tuple[str, ...] = EFFECTS
    folds: int = 2
    pose_every: int = 2
    shown_m: tuple[float, ...] = (0.105, 0.2, 0.3825)


SMOKE = Plan(nearest_m=0.3, every=4, ablated=("background",), pose_every=12, shown_m=(0.31, 0.35, 0.39))


def plan_of(preset: str) -> Plan:
    return SMOKE if preset == "smoke" else Plan()
