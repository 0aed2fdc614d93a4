"""Files, codes and networks of the published family at the command line."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
import torch
from commands import run

from csph.codes.design import Design
from csph.networks.checkpoint import load_model, save_model
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.training import config_of
from scene2spad.options.networks import Train
from scenes.errors import InputError
from spad.detection.detect import sense
from spad.formats.linospad import Capture, write_linospad
from spad.formats.mat import read_mat, write_mat
from spad.measurements.histogram import Histogram, write_histogram
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor_names import sensor_by_name


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
    # codes are 2 and 7 % off
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


def test_depth_reads_a_published_frame(capfd, folder):
    histogram = planes()
    write_histogram(histogram, Path("planes.h5"))
    write_mat(histogram, Path("frame.mat"))
    for method in (["log-matched"], ["network", "--model", "learned-256x4x4-128x-s0"]):
        ours = run(capfd, "depth", "planes.h5", "--method", *method, "--no-figure")
        theirs = run(capfd, "depth", "frame.mat", "--method", *method)
        assert theirs["mae_mm"] == ours["mae_mm"] and theirs["pixels"] == ours["pixels"]
        assert Path(f"frame-{ours['method']}.exr").is_file() and Path(theirs["figure"]).is_file()


def test_depth_reads_an_old_published_frame(capfd, folder, shared_data):
    """A frame of the training set, whose pulse stands 0.27 bins (3 mm) behind its rounded label: 0.77 less a half."""
    found = run(capfd, "depth", str(shared_data / "nyuv2/spad_0071_p1.mat"), "--out", "nyu.exr", "--no-figure")
    assert found["pixels"] + found["missing"] == 4096  # some have no photon of 10 + 2
    assert found["within_10mm"] > 0.5 and abs(found["median_mm"]) < 6


def capture(side: int = 8, frames: int = 2) -> Path:
    """Captures whose pixel (row, column) of frame f has all photons in the bin 100 + 10 row + column + 200 f."""
    made, row, column = [], *np.divmod(np.arange(side * side), side)
    for number in range(frames):
        bins = 100 + 10 * row + column + 200 * number
        columns_first = column * side + row
        made.append(Capture(scipy.sparse.csc_matrix((np.full(len(row), 40.0), (bins, columns_first)), (1536, side**2))))
    write_linospad(made, Path("capture.mat"))
    return Path("capture.mat")


def test_depth_reads_a_frame_of_a_capture(capfd, folder):
    capture()
    sensor = sensor_by_name("linospad")
    for number, first in ((0, 100), (1, 300)):
        histogram = read_mat(Path("capture.mat"), number)
        assert histogram.sensor == sensor and np.isnan(histogram.depth_m).all()
        bins = first + 10 * np.arange(8)[:, None] + np.arange(8)
        assert (histogram.counts.argmax(axis=-1) == bins).all() and (histogram.counts.sum(axis=-1) == 40).all()
    found = run(capfd, "depth", "capture.mat", "--frame", "1", "--method", "argmax")
    assert found["mae_mm"] is None and found["empty"] == 64 and Path(found["figure"]).is_file()
    status = main(["depth", "capture.mat", "--no-figure"])
    out, err = capfd.readouterr()
    assert status == 0 and "holds no true depth" in err
    assert "errors: no true depth" in out and "nan" not in out and "mm" not in out
    assert main(["compare", "capture.mat", "--methods", "argmax"]) == 0
    table = capfd.readouterr().out
    assert "no true depth" in table and "nan" not in table


def test_mat_files_that_are_none_end_in_one_line(capfd, folder):
    capture()
    assert "frame 2 is not one of its 2" in refused(capfd, "depth", "capture.mat", "--frame", "2")
    write_mat(planes(8), Path("frame.mat"))
    assert "frame.mat: is one frame and no capture" in refused(capfd, "depth", "frame.mat", "--frame", "1")
    write_histogram(planes(8), Path("planes.h5"))
    assert "--frame 1 is for captures" in refused(capfd, "depth", "planes.h5", "--frame", "1")
    scipy.io.savemat("other.mat", {"a": 1})
    assert "other.mat: SBR, bin, photons, spad are missing" in refused(capfd, "depth", "other.mat")
    Path("cut.mat").write_bytes(Path("frame.mat").read_bytes()[:3000])
    assert "cut.mat: not a readable .mat file" in refused(capfd, "depth", "cut.mat")
    halves = Capture(scipy.sparse.csc_matrix(([0.5], ([7], [0])), (1536, 4)))
    write_linospad([halves], Path("halves.mat"))
    assert "halves.mat: holds counts that are no whole numbers" in refused(capfd, "depth", "halves.mat")
    network = ["--method", "network", "--model", "learned-256x4x4-128x-s0"]
    assert "trained for another sensor" in refused(capfd, "depth", "capture.mat", *network)
    assert not list(Path().glob("*.exr"))


def published_checkpoint(path: Path) -> Path:
    """A Lightning checkpoint as the published code writes it, of Fourier rows before the published network."""
    design = Design("fourier-published", (1024, 1, 1), 8)
    model = DepthModel(ModelConfig(design=design, network="published"), seed=2)
    weights = {f"backbone_net.{name}": value.detach() for name, value in model.network.named_parameters()}
    weights["csph3d_layer.Cmat_tdim"] = model.layer.temporal[:, None, :, None, None]
    weights["csph3d_layer.irf_weights"] = torch.zeros(1, 1, 16, 1, 1)
    torch.save({"state_dict": weights, "epoch": 6, "global_step": 5194}, path)
    return path


def test_a_published_checkpoint_is_imported_and_used(capfd, folder):
    published_checkpoint(Path("epoch=6.ckpt"))
    made = run(capfd, "models", "import", "epoch=6.ckpt", "--out", "imported")
    assert made["model"] == "fourier-published 1024x1x1 K8, published" and made["compression"] == 128
    assert made["sensor"] == "iccv2023-train" and made["decoder"] == "soft-argmax, published grid"
    assert made["checkpoint"] == "imported/model.safetensors" and made["parameters"] == 568278
    histogram = planes(8, sensor_by_name("iccv2023-train"))
    write_histogram(histogram, Path("planes.h5"))
    depth = ["depth", "planes.h5", "--method", "network", "--no-figure", "--checkpoint"]
    found = run(capfd, *depth, "imported")
    direct = load_model(Path("imported"))[0].depth_of(histogram)[0]
    known = np.isfinite(histogram.depth_m)
    assert found["mae_mm"] == pytest.approx(1e3 * np.abs(direct - histogram.depth_m)[known].mean(), rel=1e-4)
    # the paper trains on the one and tests on the other: what was learned of pulses was in bins
    run(capfd, "models", "import", "epoch=6.ckpt", "--sensor", "reference", "--out", "for-tests")
    write_histogram(planes(8), Path("reference.h5"))
    run(capfd, "depth", "reference.h5", "--method", "network", "--no-figure", "--checkpoint", "for-tests")
    assert "trained for another sensor" in refused(capfd, *depth, "for-tests")


@pytest.mark.slow
def test_an_imported_model_is_evaluated(capfd, folder):
    published_checkpoint(Path("epoch=6.ckpt"))
    run(capfd, "models", "import", "epoch=6.ckpt", "--sensor", "reference", "--out", "imported")
    view = random_planes(1, size=8, seed=4)
    write_pack([(view.transients[0], {"scene": view.scenes[0]})], Path("set.h5"))
    table = run(capfd, "evaluate", "imported", "--set", "set.h5", "--baselines", "argmax")
    assert table["method"] == "fourier-published 1024x1x1 K8, published" and table["mae_mm"] > 0


def test_imports_that_cannot_be_end_in_one_line(capfd, folder):
    assert "import without a checkpoint" in refused(capfd, "models", "import")
    assert "none.ckpt: checkpoint not found" in refused(capfd, "models", "import", "none.ckpt")
    assert "go with import" in refused(capfd, "models", "--out", "x")
    torch.save({"state_dict": {"layer.weight": torch.zeros(3)}}, "other.ckpt")
    message = refused(capfd, "models", "import", "other.ckpt")
    assert "other.ckpt: tensor layer.weight is of no published compressive model" in message
    published_checkpoint(Path("good.ckpt"))
    assert "sensor 'guess' is unknown" in refused(capfd, "models", "import", "good.ckpt", "--sensor", "guess")
    message = refused(capfd, "models", "import", "good.ckpt", "--sensor", "linospad")
    assert "good.ckpt: blocks of 1024 bins do not divide the sensor's 1536" in message
    assert not Path("out").exists()
