"""Single-photon compressive histograms: coding tensors, encoding, decoding.

Names are imported when they are first used: modules without torch, `csph.waves`, can be imported alone.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from csph.codes import temporal_code, truncated_fourier
    from csph.coding import CodingTensor, encode, encode_timestamps
    from csph.decode import decode_depth
    from csph.design import Design
    from csph.layer import CompressiveLayer, LayerOptions, make_coding
    from csph.quantise import Quantised, encode_int16, quantised

_HOME = {
    "CodingTensor": "coding",
    "CompressiveLayer": "layer",
    "Design": "design",
    "LayerOptions": "layer",
    "Quantised": "quantise",
    "decode_depth": "decode",
    "encode": "coding",
    "encode_int16": "quantise",
    "encode_timestamps": "coding",
    "make_coding": "layer",
    "quantised": "quantise",
    "temporal_code": "codes",
    "truncated_fourier": "codes",
}

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


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"csph.{_HOME[name]}"), name)
    globals()[name] = value
    return value
