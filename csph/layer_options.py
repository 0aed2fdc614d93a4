"""Switches of the layer, and how learned spatial codes begin. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

from scenes.errors import did_you_mean, listed, normalise_fields, require

SpatialStart = Literal["uniform", "orthogonal"]
STARTS: tuple[str, ...] = ("uniform", "orthogonal")


@dataclass(frozen=True)
class LayerOptions:
    """Switches of the layer; the defaults are the published layer.

    zero_mean         rows of C are held to sum to zero over Mt: a uniform background then encodes to zero
    per_pixel_norm    one norm for all time blocks of a pixel (or block of pixels): which time block holds the return
                      is then not lost, and blocks without signal are not amplified
    keep_mean         the mean over K stays. Taken away, it leaves one sign bit of K = 2 and nothing of K = 1, and the
                      back-projection of Fourier series no longer moves with a delay
    pulse_in_decoder  back-project with the codes of a returning pulse, C h(tau), instead of those of one bin
    pulse_in_codes    encode and back-project with codes smoothed by the pulse
    int8              train for the chip: each factor in 255 steps within a range that is learned, sums of 16 bits that
                      wrap (a core's, before its spatial weight); rounding is passed straight through backward
    """

    zero_mean: bool = True
    per_pixel_norm: bool = False
    keep_mean: bool = False
    pulse_in_decoder: bool = False
    pulse_in_codes: bool = False
    int8: bool = False

    def __post_init__(self) -> None:
        normalise_fields(self, "layer")


def check_switches(switches: Mapping[str, bool]) -> None:
    """Raise InputError unless these are switches of LayerOptions, by name, that are on or off."""
    named = isinstance(switches, dict) and all(isinstance(name, str) for name in switches)
    require(named, f"layer {switches!r}: expected switches by name")
    known = [item.name for item in fields(LayerOptions)]
    for name in switches:
        require(name in known, f"layer {name}: is unknown{did_you_mean(name, known)}, expected {listed(known)}")
    LayerOptions(**switches)
