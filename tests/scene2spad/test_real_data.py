"""`study real-data`: from files in the prototype's layout to figures, resumed, with networks; mistakes in one line."""

import json

import numpy as np
import pytest
import scipy.io
import scipy.sparse
import torch

from csph import Design
from csph.networks.checkpoint import save_model
from csph.networks.config import ModelConfig, preset
from csph.networks.model import DepthModel
from scene2spad.cli import main
from scene2spad.studies.real_data import study as real_data
from scene2spad.studies.real_data.figures import View, directions, error_words, projected, raw_cloud
from scenes.library.catalog import load_scene
from spad.formats.linospad import read_linospad, resampled_sensor
from spad.sensor.model import Sensor


def run(capfd, *argv: str) -> dict:
    status = main(["study", "real-data", "--preset", "smoke", *argv, "--json"])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


def refused(capfd, *argv: str) -> str:
    status = main(["study", "real-data", "--preset", "smoke", *argv])
    out, err = capfd.readouterr()
    assert status == 2 and out == "" and len(err.splitlines()) == 1, err
    return err


def checkpoint(path, sensor: Sensor | None = None, front: str = "codes", block=(256, 2, 2), codes: int = 8):
    """An untrained network: what the study does with one does not hang on its weights."""
    design = Design.named("learned", block, codes=codes) if front == "codes" else None
    config = preset("smoke", ModelConfig(front=front, design=design, sensor=sensor or Sensor()))
    model = DepthModel(config.model)
    save_model(model, config, {}, path)
    return model


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_smoke_study_draws_every_figure_and_goes_on_from_what_is_there(capfd, folder):
    checkpoint(folder / "learned.safetensors")
    checkpoint(folder / "counts.safetensors", front="counts")
    argv = ("--out", "study", "--checkpoints", "learned.safetensors", "counts.safetensors")
    result = run(capfd, *argv)
    assert result["note"].startswith("No real capture was used") and next(iter(result)) == "note"
    assert sorted(path.rpartition("/")[2] for path in result["figures"]) == [
        "clouds.png",
        "real-data-128x.png",
        "real-data-256x.png",
    ]
    kept = json.loads((folder / "study/real-data.json").read_text())
    assert kept["preset"] == "smoke" and len(kept["rows"]) == len(result["rows"])  # `report` sets it apart
    assert [f"study/{name}" for name in kept["figures"]] == result["figures"]
    for figure in result["figures"]:
        assert (folder / figure).read_bytes()[:4] == b"\x89PNG"
    methods = {row["method"] for row in result["rows"]}
    assert methods == {
        *real_data.BASELINES, *real_data.CODES[128], *real_data.CODES[256],
        "network learned 256x2x2 K8, compact", "network no compression, compact",
    }  # fmt: skip
    errors = {row["method"]: row for row in result["rows"] if row["capture"] == "ornaments"}
    assert errors["log-matched"]["mae_mm"] < errors["gray-8"]["mae_mm"] < errors["coarse-8"]["mae_mm"]
    assert errors["log-matched"]["mae_mm"] < 10 and errors["log-matched"]["pixels"] > 50
    made = {path: path.stat().st_mtime_ns for path in (folder / "study" / "captures").iterdir()}
    assert len(made) == 4
    assert run(capfd, *argv) == result
    assert made == {path: path.stat().st_mtime_ns for path in (folder / "study" / "captures").iterdir()}

    # a file of one's own goes the same way, without truth
    capture = next(path for path in made if path.name.startswith("room") and path.suffix == ".mat")
    given = run(capfd, "--out", "own", "--capture", str(capture))
    assert given["note"].startswith("Captures given: room") and "truth" in given["note"]
    assert all(row["mae_mm"] is None and row["photons"] > 0 for row in given["rows"])


def test_rendered_captures_show_the_prototypes_rows_sun_and_counts(folder):
    one, settings = real_data.SIMULATED[0], real_data.PRESETS["smoke"]
    scene = real_data.scene_of(one, settings.side, 0)
    assert scene.laser.mode == "line" and scene.ambient.environment is not None
    path, truth = real_data.make_capture(one, scene, settings, folder, 0, lambda what, fraction: None)
    capture = read_linospad(path)
    assert capture.image.shape == (32, 32) and capture.image.max() > 100
    total = np.asarray(capture.counts.sum(axis=0)).reshape(32, 32).T  # pixels run down the columns
    # means over 1,024 pixels of Poisson counts: 5 standard errors
    assert abs(total.mean() - one.budget.signal - one.budget.background) < 5 * np.sqrt(80 / 1024)
    hot = np.array(real_data.prototype().dark_count_rate_hz[:32]) / 30
    steps = np.diff(total.mean(axis=1)), np.diff(hot)  # from row to row: what the scene adds hardly changes
    assert np.corrcoef(*steps)[0, 1] > 0.9 and total.mean(axis=1).argmax() == hot.argmax()
    depth, mixed = real_data.pooled_truth(truth)
    assert depth.shape == mixed.shape == (16, 16)
    assert depth[3, 5] == pytest.approx(truth.depth_m[6:8, 10:12].mean()) and mixed.any() and not mixed.all()


def test_networks_see_bins_and_tiles(folder):
    """One tile is the model itself, in bins of this sensor, and so are several tiles of a wide image."""
    model = checkpoint(folder / "m.safetensors").eval()
    sensor = resampled_sensor(real_data.prototype())
    counts = torch.from_numpy(np.random.default_rng(0).poisson(0.2, (12, 72, 1024)).astype(np.float32))
    with torch.no_grad():
        whole = model.depth_m(counts.permute(2, 0, 1)[None, None])[0] * (sensor.bin_depth_m / Sensor().bin_depth_m)
    assert torch.allclose(real_data.network(model)(counts, sensor), whole, atol=1e-5)
    assert torch.allclose(real_data.network(model, tile=8)(counts, sensor), whole, atol=1e-4)


def test_a_caption_says_over_how_many_pixels_its_error_is():
    found = {"mae_mm": 12.3, "within_10mm": 0.5, "pixels": 17}
    expected = "MAE 12 mm, 50% < 10 mm\nover 17 of 256 pixels"
    assert error_words(found, 256, mixed=True) == f"{expected}\n(mixed ones left out)"
    assert error_words(found, 256, mixed=False) == expected
    assert error_words({**found, "pixels": 0}, 256, mixed=True) == ""


def test_clouds_lie_where_the_camera_looks():
    camera = load_scene("plane", width=12, height=8).camera
    expected = camera.rays() @ camera.rotation
    assert np.allclose(directions(8, 12, camera.fov_deg), expected)
    sensor = resampled_sensor(real_data.prototype())
    counts = np.zeros((8, 12, 1024), np.float32)
    counts[2, 7, 300] = 40
    counts[..., ::50] += 1
    cloud = raw_cloud(View("c", counts, sensor, None, camera.fov_deg))
    assert np.allclose(cloud, [expected[2, 7] * 300.5 * sensor.bin_depth_m])
    # the viewer's frame is a rotation: lengths stay, what is up in the scene is up, what is further away is higher up
    turned = projected(np.array([[0, 0, 2.0], [0, -1, 2], [0, 0, 3], [1, 0, 2]]))
    assert np.allclose(np.linalg.norm(turned[1:] - turned[0], axis=1), 1)
    assert turned[1, 1] > turned[0, 1] and turned[2, 1] > turned[0, 1] and turned[3, 0] > turned[0, 0]


def test_mistakes_end_in_one_line(capfd, folder):
    scipy.io.savemat(folder / "odd.mat", {"spad_processed_data": scipy.sparse.csc_matrix((1536, 9))})
    scipy.io.savemat(folder / "other.mat", {"spad": np.zeros(3)})
    checkpoint(folder / "short.safetensors", Sensor(bins=512), codes=4)
    assert "file not found" in refused(capfd, "--capture", "none.mat")
    assert "no LinoSPAD capture" in refused(capfd, "--capture", "other.mat")
    assert "not tiled by 2 x 2" in refused(capfd, "--capture", "odd.mat")
    assert "frame 3 is not one of its 1" in refused(capfd, "--capture", "odd.mat", "--frame", "3")
    assert "two of one name" in refused(capfd, "--capture", "odd.mat", "odd.mat")
    assert not (folder / "out").exists()
    assert "network for 512 bins" in refused(capfd, "--checkpoints", "short.safetensors")
    assert "file not found" in refused(capfd, "--checkpoints", "none.safetensors")
