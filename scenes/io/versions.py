"""Versions of the packages that a result was made with, which its file keeps."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "pyproject.toml"
NOT_INSTALLED = "not installed"


@cache
def installed_version(name: str) -> str:
    """Return the version of a package, or that it is not installed.

    A scene2spad that is not installed, but runs from its source tree, has the version of that tree.

    Examples
    --------
    >>> installed_version("numpy") >= "2", installed_version("no-such-package")
    (True, 'not installed')
    """
    try:
        return version(name)
    except PackageNotFoundError:
        if name == "scene2spad" and SOURCE.is_file():
            return str(tomllib.loads(SOURCE.read_text())["project"]["version"])
        return NOT_INSTALLED


def installed_versions(*names: str) -> dict[str, str]:
    """Return the version of each of these packages by its name: see `installed_version`.

    Examples
    --------
    >>> list(installed_versions("scene2spad", "numpy"))
    ['scene2spad', 'numpy']
    """
    return {name: installed_version(name) for name in names}
