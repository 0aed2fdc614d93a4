"""Compressive histograms as strided convolutions, as the paper writes them: read this first, then `csph.layer`.

Slow and plain on purpose: one kernel of the full size a code, a stride of one block, normalisation written out. Only
tests and benches import this module.
"""

from __future__ import annotations

import torch
from torch import Tensor


def encode(counts: Tensor, tensor: Tensor) -> Tensor:
    """Encode histograms by a strided convolution.

    Parameters
    ----------
    counts : (B, 1, T, R, C) photon counts
    tensor : (K, Mt, Mr, Mc) coding tensor, cast to which the counts are

    Returns
    -------
    (B, K, T / Mt, R / Mr, C / Mc) codes, each the sum of counts times code over a block (paper, eq. 2)
    """
    return torch.nn.functional.conv3d(counts.to(tensor.dtype), tensor.unsqueeze(1), stride=tensor.shape[1:])


def zero_normalised(values: Tensor, axis: int, epsilon: float) -> Tensor:
    """Subtract the mean over an axis and divide by the norm, `epsilon` added to it."""
    centred = values - values.mean(axis, keepdim=True)
    return centred / (centred.norm(dim=axis, keepdim=True) + epsilon)


def back_project(codes: Tensor, tensor: Tensor, epsilon: float) -> Tensor:
    """Project codes back onto time bins and pixels by a transposed strided convolution.

    Codes and tensor are zero-normalised over K first: codes (B, K, T / Mt, R / Mr, C / Mc), tensor (K, Mt, Mr, Mc) ->
    (B, 1, T, R, C).
    """
    kernel = zero_normalised(tensor.unsqueeze(1), 0, epsilon)
    return torch.nn.functional.conv_transpose3d(zero_normalised(codes, 1, epsilon), kernel, stride=tensor.shape[1:])
