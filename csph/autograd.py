"""The type of what torch's own functions keep between forward and backward."""

from __future__ import annotations

from typing import Any, TypeAlias

# torch hands a `FunctionCtx` to forward and the backward node to backward; both take any attribute.
Context: TypeAlias = Any
