"""Random streams that one seed is split into: the first number of `numpy.random.SeedSequence`'s `spawn_key`."""

from __future__ import annotations

from enum import IntEnum


class Stream(IntEnum):
    """Stage that draws from a stream of random numbers. A new stage takes a number that is free.

    Results in files follow from these numbers, so that none is ever changed: also not the three that had been given
    away twice before there was one list.
    """

    EMULATE = 8
    TRIAL = 9
    PLAN = 10
    INDIRECT = 11
    AMBIENT = 12
    PILOT = 13
    MORE = 14
    SENSE = 20
    PIXELS = 21
    CROSSTALK = 22
    PATCH = 23
    TRAIN = 31
    VALIDATE = 32
    PLANES = 33
    EVALUATE = 34
    PUBLISHED = 35
    WINDOW = 36
    DEVICE_PATCH = 37
    SPATIAL_CODES = 38
    CLUTTER = 40

    # given away twice
    VIEW = 20
    ZONES = 23
    COUPLED = 36
