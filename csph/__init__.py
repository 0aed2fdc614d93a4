"""Single-photon compressive histograms: coding tensors, encoding, decoding."""

from csph.codes import temporal_code, truncated_fourier
from csph.coding import CodingTensor, encode, encode_timestamps
from csph.decode import decode_depth
from csph.design import Design
from csph.layer import CompressiveLayer, LayerOptions, make_coding
from csph.quantise import Quantised, encode_int16, published_int8, quantised

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
    "published_int8",
    "quantised",
    "temporal_code",
    "truncated_fourier",
]
