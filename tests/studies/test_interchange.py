"""Files, codes and networks of the published family at the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from csph.config import ModelConfig, TrainConfig
from csph.design import Design
from csph.model import DepthModel, load_model, save_model
from render.pack import write_pack
from scenes.errors import InputError
from spad.detect import sense
from spad.histogram import Histogram, write_histogram
from spad.sensor import PhotonBudget, Sensor
from studies.cli import main
from studies.commands import Train
from studies.planes import random_planes
from studies.training import config_of


def run(capfd, *argv: str) -> dict:
    status = main([*argv, "--json"])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


def refused(capfd, *argv: str) -> str:
    status = main(list(argv))
    out, err = capfd.readouterr()
    assert status == 2 and out == "" and len(err.splitlines()) == 1 and err.startswith("scene2spad: ")
    return err


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def planes(side: int = 16, sensor: Sensor | None = None) -> Histogram:
    transient = random_planes(1, size=side, seed=4).transients[0]
    return sense(transient, sensor or Sensor(), PhotonBudget(50, 50), seed=2)


def test_published_codes_are_designs_and_codes_by_name(capfd, folder):
    write_histogram(planes(), Path("planes.h5"))
    errors = {}
    for code in ("gray", "gray-published"):
        found = run(capfd, "depth", "planes.h5", "--method", "compressive", "--code", code, "--no-figure")
        errors[code] = found["mae_mm"]
        assert Path(f"planes-{code}-16.exr").is_file()
    assert errors["gray-published"] == pytest.approx(errors["gray"], rel=0.1)  # the same harmonics
    config = config_of(Train(design="fourier-published+learned", block=(256, 2, 2), compression=128))
    assert config.model.design == Design("fourier-published", (256, 2, 2), 8) and config.model.design.computed == 64
    model = DepthModel(config.model)
    assert model.layer.temporal[0, 0] == 1 and (model.layer.temporal[1, 1:128] < 0).all()


def test_int8_follows_the_published_rule_where_it_is_asked_to(capfd, folder):
    config = TrainConfig(model=ModelConfig(design=Design()), crop=16)
    save_model(DepthModel(config.model, 3), config, {}, Path("model.safetensors"))
    model, histogram = load_model(Path("model.safetensors"))[0], planes()
    read = {"decoder": "soft-argmax"}
    exact, calibrated, published = (
        model.depth_of(histogram, **read, **more)[0]
        for more in ({}, {"int8": True}, {"int8": True, "int8_rule": "published"})
    )
    # the layer's codes are 2 and 6 % off
    assert 0 < np.abs(calibrated - exact).mean() < np.abs(published - exact).mean()
    with pytest.raises(InputError, match="8-bit rule 'fixed' is unknown"):
        model.estimate(histogram, int8=True, int8_rule="fixed")
    write_histogram(histogram, Path("planes.h5"))
    depth = ["depth", "planes.h5", "--method", "network", "--checkpoint", "model.safetensors", "--no-figure"]
    found = [run(capfd, *depth, "--int8", *more)["mae_mm"] for more in ([], ["--int8-rule", "published"])]
    assert found[0] != found[1]
    assert "--int8-rule goes with --int8" in refused(capfd, *depth, "--int8-rule", "published")
    views = random_planes(1, size=16, seed=4)
    write_pack(((t, {"scene": s}) for t, s in zip(views.transients, views.scenes, strict=True)), Path("set.h5"))
    evaluate = ["evaluate", "model.safetensors", "--set", "set.h5", "--int8-rule", "published"]
    assert "--int8-rule goes with --int8" in refused(capfd, *evaluate)
    table = run(capfd, *evaluate, "--int8", "--baselines", "argmax")
    assert table["method"] == "learned 256x4x4 K32, compact int8 published"
