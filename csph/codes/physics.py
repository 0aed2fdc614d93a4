"""Codes as a linear operator of deepinv, for its solvers and networks; the package is imported when it is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from csph.codes.blocks import back_project, encode_blocks
from csph.codes.tensor import CodingTensor
from scenes.errors import InputError

if TYPE_CHECKING:
    from deepinv.physics import LinearPhysics


def deepinv_physics(coding: CodingTensor) -> LinearPhysics:
    """Make codes a linear operator of deepinv: A = C on every block, and its exact adjoint.

    Parameters
    ----------
    coding : CodingTensor
        K codes over blocks of Mt bins x Mr rows x Mc columns.

    Returns
    -------
    deepinv.physics.LinearPhysics
        Takes counts (B, 1, T, R, C), gives codes (B, K, T/Mt, R/Mr, C/Mc) in the type of the weights, float32. It adds
        no noise: that of photons belongs to the counts.

    Raises
    ------
    InputError
        Where deepinv is not installed; and by the operator for counts that blocks do not tile.

    Examples
    --------
    The operator A and its adjoint: <A n, y> = <n, A^T y>.

    >>> import torch
    >>> import scene2spad as s2s
    >>> physics = s2s.deepinv_physics(s2s.make_coding(s2s.Design("learned", (16, 2, 2), 8)))
    >>> counts, codes = torch.ones(1, 1, 32, 4, 4), torch.ones(1, 8, 2, 2, 2)
    >>> forward, back = physics.A(counts), physics.A_adjoint(codes)
    >>> forward.shape == codes.shape and back.shape == counts.shape
    True
    >>> bool(torch.isclose((forward * codes).sum(), (counts * back).sum(), rtol=1e-3, atol=1e-3))
    True
    """
    try:
        from deepinv.physics import LinearPhysics
    except ImportError:
        raise InputError("deepinv_physics: needs the package `deepinv`: pip install deepinv") from None
    weights = coding.tensor

    def encoded(counts: Tensor, **_: object) -> Tensor:
        return encode_blocks(counts, weights.to(counts.device))

    def projected(codes: Tensor, **_: object) -> Tensor:
        return back_project(codes, weights.to(codes.device))

    return LinearPhysics(A=encoded, A_adjoint=projected)
