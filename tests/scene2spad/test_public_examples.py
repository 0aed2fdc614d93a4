"""Every public name has an example in its docstring, and all examples run."""

import doctest
import functools
import importlib
import inspect
import re

import pytest
from deepinv_stand_in import provide_deepinv

import scene2spad as s2s

# Names whose file has no room left, or that are shown better together, by where their example stands: in the docstring
# of another public name, or of a package (`help(csph)`).
SHOWN_IN = {
    **dict.fromkeys(("Scene", "Surface", "Material", "Texture", "Camera", "Laser", "Ambient"), "scenes"),
    **dict.fromkeys(("ModelConfig", "TrainConfig", "train"), "csph"),
    "make_coding": "Design",
    "DepthModel": "load_model",
    "CoreArray": "assemble",
    "transient_from_rgbd": "Transient",
    "verify": "Program",
}
PACKAGES = ("scenes", "csph")


def named(place: str) -> object:
    return importlib.import_module(place) if place in PACKAGES else getattr(s2s, place)


def examples_of(thing: object, name: str) -> list[doctest.DocTest]:
    """Examples of a docstring, which come first, and of a class those of its methods; each with names of its own."""
    found = doctest.DocTestFinder(recurse=isinstance(thing, type)).find(thing, name, globs={})
    return sorted((one for one in found if one.examples), key=lambda one: one.name != name)


@functools.cache
def failures(place: str) -> int:
    """Count the examples of a docstring that fail; it runs once, however many names it shows."""
    return sum(doctest.DocTestRunner().run(one).failed for one in examples_of(named(place), place))


@pytest.mark.parametrize("name", s2s.__all__)
def test_every_public_name_has_an_example_that_runs(name, tmp_path, monkeypatch):
    provide_deepinv(monkeypatch)
    monkeypatch.chdir(tmp_path)
    place = SHOWN_IN.get(name, name)
    shown = [one for one in examples_of(named(place), place) if one.name == place]
    assert shown, f"the docstring of {place} has no example"
    if place != name:
        source = "".join(example.source for one in shown for example in one.examples)
        assert re.search(rf"\bs2s\.{name}\b", source), f"the example of {place} does not show {name}"
        words = inspect.getdoc(s2s.Scene if place == "scenes" else getattr(s2s, name)) or ""
        pointer = f"`help({place})`" if place in PACKAGES else f"`{place}`"
        assert f"{pointer} has an example" in " ".join(words.split()), (
            f"the docstring of {name} does not say that {place} has its example"
        )
    assert failures(place) == 0


def test_no_name_is_shown_elsewhere_that_has_an_example_of_its_own():
    assert set(SHOWN_IN) <= set(s2s.__all__)
    assert not [name for name in SHOWN_IN if ">>>" in (named(name).__doc__ or "")]
