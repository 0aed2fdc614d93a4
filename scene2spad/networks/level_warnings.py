"""Warn of what training leaves out: pile-up at the highest photon level, the sensor's dark counts at the lowest."""

from __future__ import annotations

from csph.levels import BACKGROUND, SIGNAL, Level, Levels
from csph.networks.config import TrainConfig
from spad.detection.detect import mean_pixel_law
from spad.sensor.model import PhotonBudget


def extreme_levels(levels: Levels) -> tuple[Level, float]:
    """Return the level with most photons, and the lowest background, of a list or of "continuous"."""
    if isinstance(levels, str):
        return (SIGNAL[1], BACKGROUND[1]), BACKGROUND[0]
    return max(levels, key=sum), min(background for _, background in levels)


def level_warnings(config: TrainConfig, height: int = 64, width: int = 64) -> list[str]:
    """Return a line where the mean pixel has pile-up at the highest level, and one where the dark counts of views of
    height x width pixels are above the lowest background."""
    sensor, found = config.model.sensor, []
    (signal, background), lowest = extreme_levels(config.levels)
    law, pile_up = mean_pixel_law(sensor, PhotonBudget(signal, background))
    if law != "poisson":
        found.append(
            f"train: at {signal:g} + {background:g} photons, the highest level, the mean pixel of {sensor.name} has "
            f"{pile_up:.2%} primary detections a cycle: training leaves out pile-up and dead time, which matter there"
        )
    dark = float(sensor.dark_rate_map_hz(height, width).mean() * sensor.exposure_s)
    if dark > lowest * (1 + 1e-9):
        found.append(
            f"train: sensor {sensor.name} has {dark:.4g} dark counts a pixel, the lowest level {lowest:g} background "
            "photons: at levels below them dark counts are scaled down to the level"
        )
    return found
