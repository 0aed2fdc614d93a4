"""A result states the versions that made it, where scene2spad is installed and where it runs from its tree."""

import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from scenes.io import versions

TREE = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())


@pytest.fixture(autouse=True)
def forgotten():
    versions.installed_version.cache_clear()
    yield
    versions.installed_version.cache_clear()


def test_installed_packages_have_the_versions_of_their_metadata():
    assert versions.installed_versions("numpy", "torch") == {name: version(name) for name in ("numpy", "torch")}


def test_a_tree_that_is_not_installed_has_its_own_version(monkeypatch):
    """`sense` ended in a traceback on machines to which the tree alone was copied."""

    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(versions, "version", absent)
    assert versions.installed_versions("scene2spad", "mitsuba") == {
        "scene2spad": TREE["project"]["version"],
        "mitsuba": "not installed",
    }
    versions.installed_version.cache_clear()
    monkeypatch.setattr(versions, "SOURCE", Path("no-such-file.toml"))
    assert versions.installed_version("scene2spad") == "not installed"
