"""A small set and a model trained on it, made once for each file of tests."""

from pathlib import Path

import pytest
from small_runs import QUICK

from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> Path:
    """Six scenes of planes as a pack."""
    path = tmp_path_factory.mktemp("set") / "planes.h5"
    views = random_planes(6, size=16, seed=4)
    write_pack(((t, {"scene": s}) for t, s in zip(views.transients, views.scenes, strict=True)), path)
    return path


@pytest.fixture(scope="module")
def trained(packed, tmp_path_factory) -> Path:
    """Return the folder of a run on `packed`."""
    folder = tmp_path_factory.mktemp("run") / "learned"
    assert main(["train", *QUICK, "--set", str(packed), "--out", str(folder)]) == 0
    return folder
