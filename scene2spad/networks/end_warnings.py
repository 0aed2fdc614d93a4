"""Warn of decoders that fail near the ends of a network's range, of networks trained behind another clock, and of
those whose training has not ended."""

from __future__ import annotations

import logging
from pathlib import Path

from csph.networks.config import ModelConfig
from csph.networks.periodic import ENDS_BINS
from csph.networks.posterior import Decoder
from csph.weights.cards import checkpoint_of
from csph.weights.shipped import is_unfinished
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")


def warn_of_ends(name: str, model: ModelConfig, decoder: Decoder | None) -> None:
    """Log that the soft-argmax of a periodic network is metres off near both ends of its range; decoder None: the
    model's."""
    if model.network == "periodic" and (decoder or model.decoder) == "soft-argmax":
        message = (
            "%s: its time is a circle, and the soft-argmax is a mean along a line: metres off within %d bins (%.2g m) "
            "of both ends of the range; --decoder median is not"
        )
        log.warning(message, name, ENDS_BINS, ENDS_BINS * model.sensor.bin_depth_m)


def warn_of_clock(name: str, model: ModelConfig, sensor: Sensor) -> None:
    """Log that a network was trained behind another clock than the sensor's."""
    if model.sensor.tdc != sensor.tdc:
        mine, other = (f"the clock of {one.name}" if one.tdc else "bins of one width" for one in (model.sensor, sensor))
        log.warning("%s: it was trained for %s, and this has %s: depths may be off by some 20 mm", name, mine, other)


def warn_of_unfinished(name: str | Path) -> None:
    """Log that the training of a model was stopped: its weights are those of an epoch before the last."""
    if is_unfinished(checkpoint_of(name)):
        log.warning("%s: its training has not come to its end; the same `train` command goes on with it", name)
