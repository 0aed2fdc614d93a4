"""Single-photon compressive histograms: coding tensors, encoding, decoding.

Names are imported when they are first used: modules without torch, `csph.codes.waves`, can be imported alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from csph.codes.decode import decode_depth
    from csph.codes.design import Design
    from csph.codes.quantise import Quantised, encode_int16, quantised
    from csph.codes.temporal import temporal_code, truncated_fourier
    from csph.codes.tensor import CodingTensor, encode, encode_timestamps
    from csph.layer import CompressiveLayer, LayerOptions, make_coding

__all__ = [
    "CodingTensor",
    "CompressiveLayer",
    "Design",
    "LayerOptions",
    "Quantised",
    "decode_depth",
    "encode",
    "encode_int16",
    "encode_timestamps",
    "make_coding",
    "quantised",
    "temporal_code",
    "truncated_fourier",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "csph.codes.decode": ("decode_depth",),
        "csph.codes.design": ("Design",),
        "csph.codes.quantise": ("Quantised", "encode_int16", "quantised"),
        "csph.codes.temporal": ("temporal_code", "truncated_fourier"),
        "csph.codes.tensor": ("CodingTensor", "encode", "encode_timestamps"),
        "csph.layer": ("CompressiveLayer", "LayerOptions", "make_coding"),
    },
)
