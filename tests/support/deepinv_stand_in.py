"""A stand-in for deepinv where it is not installed: its linear operator, as its documentation describes it."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from types import ModuleType

import pytest


class StandIn:
    """Calls A, and has the adjoint."""

    def __init__(self, A: Callable, A_adjoint: Callable) -> None:
        self.A, self.A_adjoint = A, A_adjoint

    def __call__(self, x: object, **more: object) -> object:
        return self.A(x, **more)


def provide_deepinv(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("deepinv") is None:
        package, physics = ModuleType("deepinv"), ModuleType("deepinv.physics")
        physics.LinearPhysics = StandIn  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "deepinv", package)
        monkeypatch.setitem(sys.modules, "deepinv.physics", physics)
