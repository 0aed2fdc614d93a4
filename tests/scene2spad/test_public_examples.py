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


PACKAGES_OF_STAGES = ("csph", "render", "spad", "ultraphase")
MORE = [f"{one}.{name}" for one in PACKAGES_OF_STAGES for name in importlib.import_module(one).__all__]
IN_STAGES = ("csph.quantised", "csph.temporal_code", "csph.truncated_fourier", "spad.estimate_depth", "spad.sense",
             "ultraphase.compile_code", "ultraphase.method")  # fmt: skip


@pytest.mark.parametrize("path", MORE)
def test_examples_of_the_stages_run(path):
    """Names that `scene2spad` offers as well are run below; of the others, those of IN_STAGES have an example."""
    package, name = path.split(".")
    thing = getattr(importlib.import_module(package), name)
    if any(thing is getattr(s2s, one) for one in s2s.__all__):
        return
    examples = examples_of(thing, name)
    assert examples or path not in IN_STAGES
    assert not sum(doctest.DocTestRunner().run(one).failed for one in examples)


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
