"""Models that come with the package in half precision, and the energy of codes that is kept while they are trained."""

import csv
import json

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.codes.temporal import bin_energy, grouped_energy, truncated_fourier
from csph.layer import make_coding
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig, preset
from csph.training.loop import train
from csph.training.views import split_views
from csph.weights.shipped import checkpoint_name, is_shipped, ship, shipped_file, shipped_names
from scene2spad.datasets.planes import random_planes
from scenes import InputError
from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget, Sensor

DESIGN = Design("learned", (1024, 1, 1), 8)


def run(folder, steps: int, design: Design = DESIGN):
    config = preset("smoke", ModelConfig(design=design), threads=1, steps_per_epoch=steps // 2)
    train(config, *split_views(random_planes(12, size=16, seed=2)), folder)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return run(tmp_path_factory.mktemp("runs") / "a-run", 8)


def test_energy_of_a_bin_is_the_mean_square_over_codes():
    # cos^2 + sin^2 of every harmonic: one half in every bin, whatever constant is added to a row
    code = truncated_fourier(8, 1024) + torch.arange(8).unsqueeze(1)
    np.testing.assert_allclose(bin_energy(code), 0.5, rtol=1e-5)
    assert grouped_energy(code).shape == (64,) and grouped_energy(code[:, :100]).shape == (50,)
    full = truncated_fourier(8, 64)[..., None, None] * torch.tensor([[1.0, 2.0], [0.0, 1.0]])
    np.testing.assert_allclose(bin_energy(full), 0.5 * 6 / 4, rtol=1e-5)


def test_energy_log_starts_and_ends_with_the_codes(trained):
    rows = list(csv.DictReader((trained / "energy.csv").open()))
    assert [int(row["step"]) for row in rows] == list(range(9))
    start = make_coding(DESIGN, Sensor(), 0).temporal
    last, _, _ = load_model(trained / "last.safetensors")
    for row, code in ((rows[0], start), (rows[-1], last.layer.temporal)):
        np.testing.assert_allclose([float(v) for v in [*row.values()][1:]], grouped_energy(code), rtol=1e-6)
    assert rows[0] != rows[-1]


def test_shipped_is_small_whole_and_tells_no_folder(trained, tmp_path):
    path = ship(trained, "some-name", tmp_path)
    assert path == shipped_file("some-name", tmp_path)
    assert path.stat().st_size < 0.55 * (trained / "model.safetensors").stat().st_size
    assert {one.name for one in path.parent.iterdir()} == {"model.safetensors", "card.json", "log.csv", "energy.csv"}
    assert shipped_names(tmp_path) == ["some-name"] and is_shipped(path)
    assert not is_shipped(trained / "model.safetensors")
    for table in ("log.csv", "energy.csv"):
        assert path.with_name(table).read_bytes() == (trained / table).read_bytes()
    message = json.loads(path.with_name("card.json").read_text())
    model, config, state = load_model(path)
    assert json.loads(json.dumps(config.to_dict())) == message["config"] and state == message["state"]
    assert config.seed == 0 and len(config.data["training_sha256"]) == 64
    for name, value in load_model(trained)[0].state_dict().items():
        kept = model.state_dict()[name]
        assert kept.dtype == torch.float32
        torch.testing.assert_close(kept, value, rtol=2**-11, atol=2**-25)  # below 2^-14 float16 has fixed steps


def test_shipping_forgets_where_the_set_lay(trained, tmp_path):
    from dataclasses import replace

    from csph.networks.checkpoint import save_model

    model, config, state = load_model(trained)
    moved = replace(config, data={**config.data, "training": "/somewhere/else/rooms.h5", "validation": "b/v.h5"})
    (tmp_path / "run").mkdir()
    save_model(model, moved, state, tmp_path / "run/model.safetensors")
    with pytest.raises(InputError, match=r"log\.csv: file not found"):
        ship(tmp_path / "run", "x", tmp_path)
    (tmp_path / "run/log.csv").write_text("step\n8\n")
    data = load_model(ship(tmp_path / "run", "x", tmp_path))[1].data
    assert (data["training"], data["validation"]) == ("rooms.h5", "v.h5")
    assert b"somewhere" not in shipped_file("x", tmp_path).read_bytes()


def test_half_precision_changes_depths_by_far_less_than_they_err(tmp_path):
    # Fourier codes decode to a few centimetres after a few steps; learned ones would take thousands
    folder = run(tmp_path / "run", 8, Design("fourier", (1024, 1, 1), 16))
    float32, half = load_model(folder)[0], load_model(ship(folder, "half", tmp_path))[0]
    histogram = sense(random_planes(1, size=24, seed=9).transients[0], Sensor(), PhotonBudget(50, 10), seed=1)
    known = np.isfinite(histogram.depth_m)
    # read by the mean: after a few steps a posterior has two halves, and its median jumps between them
    depths = [model.depth_of(histogram, decoder="soft-argmax")[0][known] for model in (float32, half)]
    errors_m = [np.abs(depth - histogram.depth_m[known]).mean() for depth in depths]
    assert errors_m[0] < 0.2 and errors_m[1] == pytest.approx(errors_m[0], rel=0.01)
    assert 0 < np.abs(depths[1] - depths[0]).mean() < 0.02 * errors_m[0]


def test_checkpoints_are_called_after_their_run_or_model(trained):
    named = {checkpoint_name(path) for path in (trained, trained / "model.safetensors", trained / "last.safetensors")}
    assert named == {"a-run"} and checkpoint_name(shipped_file("none-s0")) == "none-s0"
    assert checkpoint_name(trained / "other.safetensors") == "other"
