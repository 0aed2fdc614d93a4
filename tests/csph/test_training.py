"""The loss against its definition, samples that depend on nothing but their key, runs that go on where they stopped."""

import json
import math
import platform
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.evaluation.methods import EvaluationPlan, evaluate
from csph.networks.checkpoint import load_model, save_model, weights_sha256
from csph.networks.config import PUBLISHED_TV, ModelConfig, TrainConfig, preset
from csph.networks.model import DepthModel
from csph.training.data import Frames, Samples, SetData
from csph.training.loop import Hardware, train
from csph.training.loss import kl_divergence, pulse_target, total_variation
from csph.training.views import Views, split_views
from scene2spad.datasets.planes import random_planes
from scenes import Camera, InputError
from scenes.files import ATTRIBUTE
from spad.detection.detect import sense
from spad.detection.training_patches import pack_views
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.template import binned_pulse
from spad.sensor_names import sensor_by_name

SPEED = 299_792_458.0
# a small sensor: 64 bins over 6.4 ns, 0.96 m
SMALL = Sensor(name="small", bins=64, bin_width_s=1e-10, pulse=Pulse(1.4e-10))
GATED = replace(SMALL, name="gated", period_s=80e-10)
MODEL = ModelConfig(design=Design("learned", (32, 2, 2), 8), sensor=SMALL)
FEW = {"epochs": 3, "steps_per_epoch": 3, "batch": 2, "crop": 4, "validation_views": 2, "threads": 1}


def near_planes(count: int, seed: int = 0) -> Views:
    """Random planes within the small sensor's range: a tenth of their distance."""
    views = random_planes(count, size=16, seed=seed)
    scaled = [
        replace(t, path_near_m=t.path_near_m / 20, path_far_m=t.path_far_m / 20, depth_m=t.depth_m / 20)
        for t in views.transients
    ]
    return Views(tuple(scaled), views.scenes)


@pytest.mark.parametrize("sensor", [SMALL, GATED, Sensor(), sensor_by_name("iccv2023-train")], ids=lambda s: s.name)
def test_the_target_is_the_sensor_pulse(sensor):
    rng = np.random.default_rng(0)
    depth = torch.from_numpy(rng.uniform(0, sensor.range_m, 50)).float()
    depth[:3] = torch.tensor([0.0, 0.4 * sensor.bin_depth_m, sensor.range_m * (1 - 1e-7)])
    depth = depth[depth * 2 / SPEED < sensor.bins * sensor.bin_width_s]
    target = pulse_target(depth, sensor)
    dense = torch.zeros(len(depth), sensor.bins).scatter_add_(1, target.bins, target.mass)
    expected = binned_pulse(depth.double() * 2 / SPEED, sensor)
    expected = expected / expected.sum(-1, keepdim=True)
    assert float((dense - expected).abs().max()) < 1e-5  # float32 depths of 15 m: a third of a thousandth of a bin
    torch.testing.assert_close(target.mass.sum(-1), torch.ones(len(depth)))


def test_kl_divergence_is_its_definition():
    rng = np.random.default_rng(1)
    depth = torch.from_numpy(rng.uniform(0.05, 0.9, (2, 3, 4)).astype(np.float32))
    valid = torch.ones(2, 3, 4, dtype=torch.bool)
    valid[0, 0, 0] = False
    depth[0, 0, 0] = math.nan
    logits = torch.randn(2, 64, 3, 4, requires_grad=True)
    loss = kl_divergence(logits, depth, valid, SMALL)
    loss.backward()
    fast = logits.grad.clone()
    h = binned_pulse(depth[valid].double() * 2 / SPEED, SMALL)
    h = h / h.sum(-1, keepdim=True)
    logits.grad = None
    logp = logits.movedim(1, -1)[valid].double().log_softmax(-1)
    expected = (torch.xlogy(h, h) - h * logp).sum(-1).mean()
    expected.backward()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    torch.testing.assert_close(fast, logits.grad, rtol=1e-4, atol=1e-7)
    assert not fast[0, :, 0, 0].any()


def test_kl_divergence_by_hand():
    depth, valid = torch.full((1, 1, 1), 0.5), torch.ones(1, 1, 1, dtype=torch.bool)
    h = binned_pulse(torch.tensor([0.5 * 2 / SPEED]), SMALL)[0]
    h = (h / h.sum()).clamp(min=1e-30)
    entropy = float(-(h * h.log()).sum())
    flat = torch.zeros(1, 64, 1, 1)
    assert float(kl_divergence(flat, depth, valid, SMALL)) == pytest.approx(math.log(64) - entropy, rel=1e-6)
    best = h.log().float().view(1, 64, 1, 1)
    assert float(kl_divergence(best, depth, valid, SMALL)) == pytest.approx(0, abs=2e-6)
    assert float(kl_divergence(flat, depth, ~valid, SMALL)) == 0


def test_total_variation_by_hand():
    values = torch.tensor([[[1.0, 2.0, 4.0], [1.0, 0.0, 0.0]]])
    assert float(total_variation(values)) == pytest.approx((1 + 2 + 1 + 0 + 0 + 2 + 4) / 6)
    assert float(total_variation(torch.ones(2, 5, 5))) == 0
    # the published weight: 1e-5 of a sum over the batch, beside a divergence divided by 1024 bins
    depth, patches = torch.rand(4, 32, 32), 4 * 32 * 32
    published = 1e-5 * (depth.diff(dim=1).abs().sum() + depth.diff(dim=2).abs().sum())
    assert float(PUBLISHED_TV * total_variation(depth) / 1024) == pytest.approx(float(published), rel=1e-5)
    assert patches == 4096


def test_samples_depend_on_their_key_alone():
    packed = [pack_views(near_planes(4).transients)]
    config = preset("smoke", MODEL, **FEW, levels="paper")
    first, again, later = (Samples(packed, config, epoch) for epoch in (0, 0, 1))
    assert [first[i] for i in range(6)] == [again[i] for i in range(6)] != [later[i] for i in range(6)]
    assert {p.patch.signal for p in map(first.__getitem__, range(6))} <= {10, 5, 2}
    levels = {(p.signal, p.background) for p in (first[i].patch for i in range(200))}
    assert len(levels) == 9
    alone, ahead = (SetData(packed, packed, config, workers).train_dataloader() for workers in (0, 2))
    for one, other in zip(alone, ahead, strict=True):
        assert all(torch.equal(torch.nan_to_num(a), torch.nan_to_num(b)) for a, b in zip(one, other, strict=True))


def test_validation_frames_are_whole_and_spread():
    packed = pack_views(near_planes(5).transients)
    frames = Frames(packed, preset("smoke", MODEL, **{**FEW, "validation_views": 45}))
    requests = [frames[i] for i in range(45)]
    assert frames.size == (16, 16) and {r.patch.scene for r in requests} == set(range(5))
    few = Frames(packed, preset("smoke", MODEL, **{**FEW, "validation_views": 5}))
    assert len({few[i].patch.scene for i in range(5)}) == 5


def test_split_is_by_scene():
    views = near_planes(6)
    doubled = Views(views.transients * 2, views.scenes * 2)
    training, validation = split_views(doubled)
    assert not set(training.scenes) & set(validation.scenes)
    assert len(training.transients) == 10 and len(validation.transients) == 2
    with pytest.raises(InputError, match="a set of one scene"):
        split_views(Views(views.transients[:1], views.scenes[:1]))


class Stopped(Exception):
    pass


def test_interruption_is_passed_on(tmp_path):
    def stop(what: str, fraction: float) -> None:
        raise KeyboardInterrupt

    handler = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(KeyboardInterrupt):
            train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path / "run", progress=stop)
    finally:
        signal.signal(signal.SIGINT, handler)  # Lightning leaves it ignored


def test_images_are_cut_to_whole_blocks():
    model = DepthModel(MODEL).eval()
    views = random_planes(1, size=17, seed=2)
    found = evaluate({"n": lambda h: model.depth_of(h)[0]}, views, SMALL, EvaluationPlan([(20, 20)], tile=(2, 2)))
    row = found.rows[0]
    assert (
        row.group == "all" and row.pixels + row.beyond_range == np.isfinite(views.transients[0].depth_m[:16, :16]).sum()
    )
    with pytest.raises(InputError, match="image of 17 x 17 pixels is smaller than a block of 32 x 32"):
        evaluate({"n": lambda h: h.depth_m}, views, SMALL, EvaluationPlan([(20, 20)], tile=(32, 32)))


def test_a_run_that_stops_goes_on_to_the_same_weights(tmp_path):
    views = split_views(near_planes(6))
    config = preset("smoke", MODEL, **FEW, tv_weight=1.0, tv_start=2, time_offset_m=0.01)
    whole = train(config, *views, tmp_path / "whole")
    assert whole["steps"] == 9

    def stop(what: str, fraction: float) -> None:
        if what == "step 5 of 9":
            raise Stopped

    with pytest.raises(Stopped):
        train(config, *views, tmp_path / "parts", progress=stop)
    assert not (tmp_path / "parts" / "last.safetensors").exists()
    parts = train(config, *views, tmp_path / "parts")
    assert parts["steps"] == 9
    for name in ("last.safetensors", "model.safetensors", "log.csv", "config.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    rows = (tmp_path / "whole" / "log.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows] == ["step", "3", "6", "9"]
    rmse_mm = [float(row.split(",")[4]) for row in rows[1:]]
    assert whole["val_rmse_mm"] == pytest.approx(rmse_mm[-1])  # one cosine: the last
    stepped = train(replace(config, schedule="steps"), *views, tmp_path / "steps")
    rows = (tmp_path / "steps" / "log.csv").read_text().splitlines()
    assert stepped["val_rmse_mm"] == pytest.approx(min(float(row.split(",")[4]) for row in rows[1:]))
    # the same folder, other numbers or another set
    differs = f"holds a run with other options or another set (rate: {config.rate} there, 0.0001 asked); choose"
    with pytest.raises(InputError, match=re.escape(differs)):
        train(replace(config, rate=1e-4), *views, tmp_path / "whole")
    with pytest.raises(InputError, match=r"another set \(data\.training_sha256: .* there, .* asked; data\.valid"):
        train(config, *split_views(near_planes(6, seed=1)), tmp_path / "whole")


def test_training_learns(tmp_path):
    """A few steps on bright planes of 64 bins: the error falls to a small part of what the start gives."""
    views = split_views(near_planes(12))
    changes = {"epochs": 2, "steps_per_epoch": 60, "batch": 4, "crop": 8, "rate": 5e-3, "levels": ((200.0, 5.0),)}
    config = preset("smoke", MODEL, **{**FEW, **changes})
    train(config, *views, tmp_path / "run")
    model, _, state = load_model(tmp_path / "run")
    assert state["train_loss"] < 1.0  # an even guess has log 64 - entropy = 2.4
    histogram = sense(views[1].transients[0], SMALL, PhotonBudget(200, 5), seed=3)
    errors = []
    for candidate in (DepthModel(MODEL, config.seed).eval(), model):
        depth, _ = candidate.depth_of(histogram)
        errors.append(float(np.nanmean(np.abs(depth - histogram.depth_m))))
    assert errors[1] < errors[0] / 3


@pytest.mark.parametrize(
    "model",
    [
        MODEL,
        replace(MODEL, design=Design("fourier", (64, 2, 2), 4), layer={"per_pixel_norm": True}),
        replace(MODEL, design=None, front="counts", network="published"),
        replace(MODEL, design=None, front="peak", network="published-signed"),
    ],
    ids=lambda m: m.name,
)
def test_checkpoints_come_back(model, tmp_path):
    config = preset("smoke", model, **FEW)
    saved = DepthModel(model, 3)
    save_model(saved, config, {"step": 7, "val_rmse_mm": 1.5}, tmp_path / "model.safetensors")
    loaded, same, state = load_model(tmp_path)
    assert same == config and state == {"step": 7, "val_rmse_mm": 1.5}
    assert weights_sha256(loaded) == weights_sha256(saved)
    histogram = sense(near_planes(1).transients[0], SMALL, PhotonBudget(20, 20))
    assert np.array_equal(loaded.depth_of(histogram)[0], saved.depth_of(histogram)[0])
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_peaks_and_codes_of_8_bits():
    histogram = sense(near_planes(1).transients[0], SMALL, PhotonBudget(20, 20))
    counts = torch.from_numpy(histogram.counts).permute(2, 0, 1)[None, None]
    peak = DepthModel(replace(MODEL, design=None, front="peak")).network_input(counts)
    assert torch.equal(peak.sum(2), torch.ones(1, 1, 16, 16))
    assert torch.equal(peak.argmax(2), counts.argmax(2))  # the first of equals
    model = DepthModel(MODEL, 1).eval()
    depth, overflows = model.depth_of(histogram, int8=True)
    exact, none = model.depth_of(histogram)
    assert overflows == none == 0
    exact, _ = model.depth_of(histogram, decoder="soft-argmax")
    depth, _ = model.depth_of(histogram, int8=True, decoder="soft-argmax")
    assert 0 < np.abs(depth - exact).max() < 0.05 * SMALL.range_m
    with pytest.raises(InputError, match="no codes to hold in 8 bits"):
        DepthModel(replace(MODEL, design=None, front="counts")).depth_of(histogram, int8=True)


def test_matched_counts_are_the_zero_normalised_correlation_with_the_pulse():
    """In [-1, 1]; 1 where a noise-free pulse is; the same for any scale and level of the counts; 0 for a flat pixel."""
    arrival = torch.tensor([10.5, 40.5], dtype=torch.float64) * SMALL.bin_width_s
    pulses = binned_pulse(arrival, SMALL).float()
    counts = torch.cat([3 * pulses, 700 * pulses + 5, torch.full((1, SMALL.bins), 2.0)]).T.reshape(1, 1, -1, 1, 5)
    seen = DepthModel(replace(MODEL, design=None, front="matched")).network_input(counts)
    assert seen.shape == counts.shape and seen.abs().max() < 1 + 1e-5
    assert seen[0, 0, :, 0].argmax(0).tolist()[:4] == [10, 40, 10, 40]
    assert torch.allclose(seen.amax(2)[..., :4], torch.ones(4), atol=1e-4)
    assert torch.allclose(seen[..., :2], seen[..., 2:4], atol=1e-3) and (seen[..., 4].abs() < 1e-3).all()


def test_damaged_and_foreign_checkpoints(tmp_path):
    path = tmp_path / "model.safetensors"
    config = preset("smoke", MODEL, **FEW)
    save_model(DepthModel(MODEL), config, {}, path)
    good = path.read_bytes()

    def refused(contents: bytes) -> str:
        path.write_bytes(contents)
        with pytest.raises(InputError) as caught:
            load_model(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)
        return str(caught.value)

    assert "not a readable checkpoint" in refused(good[:-20])
    assert "not a readable checkpoint" in refused(b"nothing")
    assert "do not match their SHA-256" in refused(good[:-1] + bytes([good[-1] ^ 1]))
    newer = good.replace(b'\\"schema\\": 1', b'\\"schema\\": 9')
    assert newer != good and "network of schema 9, this program reads 1" in refused(newer)
    foreign = good.replace(ATTRIBUTE.encode(), b"somethings"[: len(ATTRIBUTE)].ljust(len(ATTRIBUTE), b"x"))
    assert "no checkpoint of scene2spad" in refused(foreign)
    other = preset("smoke", replace(MODEL, design=Design("learned", (32, 2, 2), 16)), **FEW)
    save_model(DepthModel(MODEL), other, {}, path)
    assert "of another design than learned 32x2x2 K16" in refused(path.read_bytes())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crop": 5}, "not tiled by blocks of 2 x 2"),
        ({"crop": 32}, "do not fit views of 16"),
        ({"rate": 0.0}, "learning rate 0 is outside"),
        ({"precision": "bf16"}, "expected 32-true"),
        ({"precision": "bf16-mixed"}, "needs a GPU"),
        ({"epochs": 0}, "epochs 0 is below 1"),
        ({"levels": ()}, "no photon level"),
    ],
)
def test_bad_configurations(change, message, tmp_path):
    with pytest.raises(InputError, match=message):
        config, hardware = preset("smoke", MODEL, **{**FEW, **change}), Hardware(accelerator="cpu")
        train(config, *split_views(near_planes(3)), tmp_path / "x", hardware=hardware)
    assert not (tmp_path / "x").exists()


def test_histograms_that_do_not_fit():
    model = DepthModel(MODEL).eval()
    planes = near_planes(1).transients[0]
    with pytest.raises(InputError, match="trained for another sensor"):
        model.depth_of(sense(planes, replace(SMALL, pulse=Pulse(3e-10)), PhotonBudget(5, 5)))
    with pytest.raises(InputError, match="blocks of 48 bins do not divide the sensor's 64"):
        replace(MODEL, design=Design("learned", (48, 2, 2), 8))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library than glibc")
def test_freed_memory_is_kept():
    script = (
        "import resource, numpy as np\n"
        "from render.backend.malloc import retain_freed_memory\n"
        "def faults():\n"
        "    start = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "    for _ in range(20):\n"
        "        np.ones(1 << 21)\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - start\n"
        "retain_freed_memory()\n"
        "print(faults(), faults())\n"
    )
    message = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    pages = (8 << 21) // 4096
    first, later = map(int, message.split())
    assert first < 2 * pages and later < pages / 4  # once, not twenty times


def test_a_networks_depth_knows_where_the_laser_is():
    """A half path beside a displaced laser becomes a distance, for networks as for the filters."""
    from spad.estimators.bistatic import radial_depth_m

    camera = {"pose": np.eye(4).tolist(), "fov_deg": 60.0, "width": 16, "height": 16}
    views, baseline = near_planes(1), (0.1, 0.0, 0.02)
    model = DepthModel(MODEL).eval()

    def depth(baseline_m: tuple[float, ...]) -> np.ndarray:
        meta = {"camera": camera, "laser": {"mode": "flood", "baseline_m": list(baseline_m)}}
        transient = replace(views.transients[0], meta=meta)
        return model.depth_of(sense(transient, SMALL, PhotonBudget(20, 20), seed=1))[0]

    rays = Camera(np.eye(4), 60.0, 16, 16).rays()
    expected = radial_depth_m(depth((0.0, 0.0, 0.0)), rays, baseline)
    assert np.array_equal(depth(baseline), expected) and not np.allclose(expected, depth((0.0, 0.0, 0.0)), atol=1e-3)
