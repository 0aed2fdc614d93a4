"""Measure how well codes tell the pixels of a block apart: participation rank and coherence of a coding tensor."""

from __future__ import annotations

import torch
from torch import Tensor


def pixel_gram(weights: Tensor) -> Tensor:
    """Return the Gram matrix (Mr Mc, Mr Mc) of the pixels of a coding tensor (K, Mt, Mr, Mc), or (K, Mt) of one pixel.

    Entry (p, q) is the inner product, over codes and time bins, of the weights of pixels p and q.
    """
    rows = weights.reshape(weights.shape[0] * weights.shape[1], -1)
    return rows.T @ rows


def separable_gram(temporal: Tensor, spatial: Tensor) -> Tensor:
    """Return `pixel_gram` of temporal (K, Mt) x spatial (K, Mr, Mc) without forming it."""
    flat = spatial.flatten(1)
    return flat.T @ (flat * temporal.square().sum(1, keepdim=True))


def participation_rank(gram: Tensor) -> float:
    """Return (sum l)^2 / sum l^2 of a Gram matrix's eigenvalues l = (trace)^2 / |G|_F^2: from 1, all pixels are coded
    alike, to Mr Mc, all directions are coded with the same energy. 0 of a matrix of zeros."""
    square = float(gram.double().square().sum())
    return float(gram.double().trace()) ** 2 / square if square > 0 else 0.0


def coherence(gram: Tensor) -> Tensor:
    """Return mean squared cosine between the codes of two different pixels, in [0, 1]; 0 for a single pixel."""
    pixels = len(gram)
    if pixels == 1:
        return gram.new_zeros(())
    length = gram.diagonal().clamp(min=torch.finfo(gram.dtype).tiny).sqrt()
    cosine = gram / (length.unsqueeze(0) * length.unsqueeze(1))
    return (cosine.square().sum() - pixels) / (pixels * (pixels - 1))
