"""The type of what torch's own functions keep between forward and backward."""

from __future__ import annotations

from typing import Any, TypeAlias

from torch import Tensor
from torch.autograd import Function

# torch hands a `FunctionCtx` to forward and the backward node to backward; both take any attribute.
Context: TypeAlias = Any


def applied(function: type[Function], *inputs: object) -> Tensor:
    """Call `function.apply`, which torch leaves without types, on what its `forward` takes."""
    return function.apply(*inputs)
