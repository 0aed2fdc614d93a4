"""Single-photon compressive histograms: coding tensors, encoding, decoding."""

from csph.coding import CodingTensor, decode_depth, encode, encode_timestamps, truncated_fourier

__all__ = ["CodingTensor", "decode_depth", "encode", "encode_timestamps", "truncated_fourier"]
