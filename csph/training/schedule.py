"""The learning rate as a function of the step alone."""

from __future__ import annotations

import math

from csph.networks.config import TrainConfig


def rate_factor(step: int, config: TrainConfig) -> float:
    """Return what the rate of `config` is multiplied by at a step, from 0: a linear warm-up, then steps down or one
    cosine.

    steps: decay^(step // decay_steps). cosine: from 1 to `rate_end` over all steps of the run, and there from then on.
    """
    rise = min(1.0, (step + 1) / config.warmup) if config.warmup else 1.0
    if config.schedule == "steps":
        return rise * config.decay ** (step // config.decay_steps)
    done = min(1.0, step / config.steps)
    return rise * (config.rate_end + (1 - config.rate_end) * 0.5 * (1 + math.cos(math.pi * done)))
