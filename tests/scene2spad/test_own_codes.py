"""Networks behind fixed codes of a user's file: the run needs the file no more, and what cannot work is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, run
from small_runs import QUICK

from csph.codes.design import OWN, Design
from csph.codes.files import own_codes
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from csph.weights.cards import model_coding, read_card
from csph.weights.shipped import CARD, RESUME, ship
from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.datasets.planes import wall
from scene2spad.studies.chip.code import with_headroom
from scenes import InputError
from spad.detection.detect import sense
from spad.measurements.histogram import write_histogram
from spad.sensor.model import PhotonBudget, Sensor

TIME = (np.arange(1024) + 0.5) / 1024
ROWS = np.array([np.cos(2 * np.pi * k * TIME + phase) for k in range(1, 5) for phase in (0, 0.5 * np.pi)])
TRAIN = ["train", *QUICK, "--codes-file"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("mine.npy", ROWS)
    np.save("block.npy", np.random.default_rng(0).normal(size=(4, 256, 2, 2)))


def test_a_run_with_own_codes_needs_their_file_no_more(capfd):
    assert run(capfd, *TRAIN, "mine.npy", "--out", "run", "--dry-run")["dry_run"]
    found = run(capfd, *TRAIN, "mine.npy", "--out", "run")
    file = Path("mine.npy").read_bytes()
    assert Path("run/codes.npy").read_bytes() == file
    whole = Path("run/model.safetensors").read_bytes()
    Path("mine.npy").unlink()
    assert np.array_equal(model_coding("run").temporal, ROWS.astype(np.float32))
    # the same options once more: a run that is over, and one that goes on from its first epoch
    assert run(capfd, *TRAIN, "mine.npy", "--out", "run") | {"seconds": 0} == found | {"seconds": 0}
    for name in ("last.safetensors", "model.safetensors", RESUME):
        Path("run", name).unlink()
    run(capfd, *TRAIN, "mine.npy", "--out", "run")
    assert Path("run/model.safetensors").read_bytes() == whole
    histogram = sense(wall(2.0, 8), Sensor(), PhotonBudget(50, 10))
    write_histogram(histogram, Path("wall.h5"))
    run(capfd, "depth", "wall.h5", "--method", "network", "--checkpoint", "run", "--no-figure")
    write_transient(wall(2.0, 8), Path("wall.exr"))
    words = "evaluate run --set wall.exr --baselines argmax --levels 50+1 --int8"
    assert main(words.split()) == 0
    assert "a single scene has no 95 % interval" in capfd.readouterr().err
    run(capfd, *TRAIN, "run/codes.npy", "--init", "run", "--layer", "int8", "--out", "int8")
    run(
        capfd,
        "train",
        *QUICK,
        "--design",
        "fourier",
        "--block",
        "1024",
        "1",
        "1",
        "--init-network",
        "run",
        "--out",
        "f",
    )
    card = read_card(ship(Path("run"), "mine", Path("shipped")).with_name(CARD))
    assert card.compression == 128 and "mine.npy" in Path("shipped/mine", CARD).read_text()
    assert np.abs(model_coding("shipped/mine/model.safetensors").temporal.numpy() - ROWS).max() < 1e-3


def test_the_network_sees_what_the_file_has(capfd):
    """Codes that do not sum to zero stay so: a sensor that has them sends these numbers."""
    np.save("gates.npy", np.repeat(np.eye(4), 256, axis=1)[:, :, None, None])
    for name in ("gates.npy", "block.npy"):
        run(capfd, *TRAIN, name, "--steps", "2", "--out", name[:-4])
        model, config, _ = load_model(Path(name[:-4]))
        counts = torch.poisson(torch.full((1, 1, 1024, 4, 4), 0.3))
        design, coding = own_codes(Path(name))
        assert config.model.design == design and config == TrainConfig.from_dict(
            json.loads(json.dumps(config.to_dict()))
        )
        bins, rows, columns = design.block
        blocks = counts.view(1024 // bins, bins, 4 // rows, rows, 4 // columns, columns).double()
        expected = torch.einsum("ktrc,atbrdc->kabd", coding.tensor.double(), blocks)
        torch.testing.assert_close(model.codes_layer.encode(counts)[0].double(), expected, rtol=1e-5, atol=1e-4)
    assert with_headroom(load_model(Path("gates"))[0], 1).own_codes is not None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["mine.npy", "--design", "fourier"], "train --codes-file mine.npy: --design fourier is for codes of no file"),
        (["mine.npy", "--full"], "train --codes-file mine.npy: --full is for designs with codes of no file"),
        (
            ["mine.npy", "--block", "512", "1", "1"],
            "--block 512 1 1: mine.npy holds 8 codes over blocks of 1024 x 1 x 1",
        ),
        (["mine.npy", "--codes", "16"], "--codes 16: mine.npy holds 8 codes"),
        (["mine.npy", "--compression", "64"], "--compression 64.0: mine.npy holds 8 codes"),
        (["mine.npy", "--spatial-start", "uniform"], "--spatial-start uniform is for spatial codes that are learned"),
        (["mine.npy", "--network", "periodic", "--layer", "keep_mean"], "mine.npy: network periodic: is for Fourier"),
        (["block.npy", "--layer", "int8"], "int8 is for codes with a table of their own, not counters or full tensors"),
        (["odd.npy"], "odd.npy: blocks of 1000 bins do not divide the sensor's 1024"),
        (["nan.npy"], "nan.npy: coding tensor nan: temporal part of shape (2, 1024), expected finite values"),
        (["none.npy"], "none.npy: array file not found"),
        (["mine.npy", "--init", "fourier-1024x1x1-128x-s0"], "cannot begin one of own-"),
    ],
)
def test_options_that_do_not_go_with_a_file_of_codes(capfd, options, message):
    np.save("odd.npy", np.eye(8, 1000))
    np.save("nan.npy", np.full((2, 1024), np.nan))
    assert message in refused(capfd, *TRAIN, *options, "--out", "run") and not Path("run").exists()


def test_options_that_agree_with_the_file_are_taken(capfd):
    agreeing = ["--block", "1024", "1", "1", "--codes", "8"]
    assert run(capfd, *TRAIN, "mine.npy", *agreeing, "--dry-run", "--out", "x")["dry_run"]
    assert run(capfd, *TRAIN, "mine.npy", "--compression", "128", "--dry-run")["out"] == "out/train/mine-smoke-0"


def test_codes_that_tell_nothing_are_refused_and_dependent_ones_told(capfd):
    np.save("zero.npy", np.zeros((4, 1024)))
    assert refused(capfd, *TRAIN, "zero.npy", "--out", "zero") == "scene2spad: zero.npy: all codes are zero"
    np.save("alike.npy", np.repeat(ROWS[:1], 4, 0))
    for dry in ([], ["--dry-run"]):  # a network of nothing but zeros had been trained
        message = refused(capfd, *TRAIN, "alike.npy", "--out", "alike", *dry)
        assert "alike.npy: all its codes are the same: their mean over K is removed, which leaves zeros" in message
    assert run(capfd, *TRAIN, "alike.npy", "--layer", "keep_mean", "--out", "alike", "--dry-run")["dry_run"]
    np.save("twice.npy", np.concatenate([ROWS, ROWS]))
    assert main([*TRAIN, "twice.npy", "--out", "twice"]) == 0
    assert "twice.npy: its 16 codes have rank 8: the others follow from so many" in capfd.readouterr().err


def test_other_codes_are_another_run(capfd):
    run(capfd, *TRAIN, "mine.npy", "--out", "run")
    np.save("mine.npy", ROWS[::-1])
    assert "holds a run with other options or another set (model.design.sha256" in refused(
        capfd, *TRAIN, "mine.npy", "--out", "run"
    )
    assert "cannot begin one of own-" in refused(capfd, *TRAIN, "mine.npy", "--init", "run", "--out", "again")


@pytest.mark.parametrize("option", ["--init", "--init-network", "--design"])
def test_an_array_in_the_place_of_a_model_names_the_option_for_codes(capfd, option):
    expected = f"train: {option} mine.npy: is a file of codes, expected --codes-file mine.npy"
    assert expected in refused(capfd, "train", *QUICK, option, "mine.npy", "--out", "run")


def test_own_codes_in_python():
    design, coding = own_codes(Path("mine.npy"))
    assert design.code == OWN and design.block == (1024, 1, 1) and design.codes == 8 and not design.learned
    assert "sha256" not in TrainConfig(ModelConfig(design=Design())).to_dict()["model"]["design"]
    config = ModelConfig(design=design)
    assert DepthModel(config, own=coding).own_codes.temporal.shape == (8, 1024)
    with pytest.raises(InputError, match=r"its codes are in a file, which `csph.codes.files.own_codes` reads"):
        DepthModel(config)
    with pytest.raises(InputError, match=r"own codes are \(4, 256, 2, 2\), expected \(8, 1024\)"):
        DepthModel(config, own=own_codes(Path("block.npy"))[1])
    with pytest.raises(InputError, match=r"own codes .* are for a design of own codes"):
        DepthModel(ModelConfig(design=Design("fourier", (1024, 1, 1), 8)), own=coding)
    with pytest.raises(InputError, match="design 'own' is unknown"):
        Design.named(OWN, (1024, 1, 1), codes=8)
    with pytest.raises(InputError, match="sha256 '', expected that of a file of own codes alone"):
        Design(OWN, (1024, 1, 1), 8, spatial_learned=False)
