"""Warn of decoders that fail near the ends of a network's range."""

from __future__ import annotations

import logging

from csph.networks.config import ModelConfig
from csph.networks.periodic import ENDS_BINS
from csph.networks.posterior import Decoder

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
