"""Public names of a package that are imported when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence


def lazy_names(
    package: str, names_of: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return a package's `__getattr__` and `__dir__`, which import a name's module when the name is first used.

    Parameters
    ----------
    package : `__name__` of the package
    names_of : public names by the full name of the module that defines them

    Examples
    --------
    >>> getter, lister = lazy_names("scenes", {"scenes.constants": ("SPEED_OF_LIGHT_M_PER_S",)})
    >>> getter("SPEED_OF_LIGHT_M_PER_S"), lister()
    (299792458, ['SPEED_OF_LIGHT_M_PER_S'])
    """
    module_of = {name: module for module, names in names_of.items() for name in names}

    def get(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted(module_of)

    return get, names
