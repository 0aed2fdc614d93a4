"""Training for the chip: rounding and wrapping forward, straight through backward, ranges that learn headroom."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_training import FEW, SMALL, near_planes

from csph.codes.design import Design
from csph.codes.files import write_codes
from csph.codes.quantise import clipped_steps, encode_int16, published_int8, quantised
from csph.layer import CompressiveLayer
from csph.networks.checkpoint import load_model, save_model
from csph.networks.config import ModelConfig, preset
from csph.networks.model import DepthModel
from csph.training.loop import DepthTraining, train
from csph.training.views import split_views
from scenes import InputError
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

LEARNED, FOURIER = Design("learned", (16, 2, 2), 4), Design("fourier", (64, 1, 1), 8)


def counts(design: Design, mean: float = 0.4, peak: int = 0) -> torch.Tensor:
    random = np.random.default_rng(1)
    found = random.poisson(mean, (2, 1, 64, 4, 4)).astype(np.float32)
    found[:, :, 21] += peak
    return torch.from_numpy(found)


@pytest.mark.parametrize("design", [LEARNED, FOURIER, Design("learned", (64, 1, 1), 8)], ids=lambda d: d.name)
def test_ranges_begin_where_rounding_of_trained_weights_has_them(design):
    made, plain = CompressiveLayer.of(design, int8=True).quantised(), quantised(CompressiveLayer.of(design).coding())
    assert np.array_equal(made.temporal, plain.temporal) and made.temporal_scale == pytest.approx(plain.temporal_scale)
    assert np.array_equal(made.tensor, plain.tensor) and made.scale == pytest.approx(plain.scale)


@pytest.mark.parametrize("peak", [0, 700])
def test_codes_are_sums_of_int8_steps_that_wrap_at_16_bits(peak):
    """One core a pixel: the integers of `encode_int16`; a block: of every core, before its weight."""
    layer, seen = CompressiveLayer.of(FOURIER, int8=True), counts(FOURIER, peak=peak)
    exact, over = encode_int16(seen, layer.quantised())
    assert (over > 0) == (peak > 0)
    torch.testing.assert_close(layer.encode(seen), exact * layer.quantised().temporal_scale, rtol=1e-6, atol=0)

    layer = CompressiveLayer.of(LEARNED, int8=True)
    made, found = layer.quantised(), layer.encode(seen).detach()
    steps, weights = made.temporal.astype(np.int64), made.spatial.astype(np.int64)
    for image, k, time, row, column in np.ndindex(found.shape):
        total = 0
        for r, c in np.ndindex(2, 2):
            photons = seen[image, 0, 16 * time : 16 * time + 16, 2 * row + r, 2 * column + c].numpy().astype(np.int64)
            total += int(weights[k, r, c]) * int(np.int64((steps[k] * photons).sum()).astype(np.int16))
        expected = total * made.temporal_scale * made.spatial_scale
        assert found[image, k, time, row, column] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_sums_that_wrap_in_a_layer_trained_for_the_chip_are_counted():
    """Without `int8=True` as well: its codes are sums of 16 bits in any case. Each wrapped sum counts once in tiles."""
    sensor = Sensor(name="small", bins=64, bin_width_s=1e-10)
    model = DepthModel(ModelConfig(design=LEARNED, sensor=sensor, layer={"int8": True}), 1).eval()
    seen = np.random.default_rng(2).poisson(0.4, (10, 6, 64))
    seen[3:5, 2, 21] += 700
    steps = model.codes_layer.quantised().temporal.astype(np.int64)
    sums = np.einsum("km,rctm->rckt", steps, seen.reshape(10, 6, 4, 16))
    expected = int((sums != sums.astype(np.int16)).sum())
    histogram = Histogram.from_counts(seen, sensor)
    assert model.estimate(histogram).overflows == model.estimate(histogram, tile=4).overflows == expected > 0
    assert model.depth_of(Histogram.from_counts(np.minimum(seen, 2), sensor))[1] == 0


def test_backward_goes_straight_through_the_rounding():
    """d(steps x step) / d value is 1 within the range and 0 outside it; by the range it is LSQ's."""
    values = torch.tensor([0.3, -0.71, 0.999, 1.4, -3.0], requires_grad=True)
    log_range = torch.tensor(0.0, requires_grad=True)
    steps, step = clipped_steps(values, log_range)
    assert steps.tolist() == [38, -90, 127, 127, -127]
    towards = torch.tensor([1.0, 2.0, -1.0, 4.0, 8.0])
    (steps * step * towards).sum().backward()
    inside = torch.tensor([1.0, 1, 1, 0, 0])
    torch.testing.assert_close(values.grad, inside * towards)
    rounding = torch.where(inside > 0, steps - 127 * values, steps).detach()
    torch.testing.assert_close(log_range.grad, (rounding * towards).sum() / 127)


def test_codes_learn_as_those_in_floating_point_do():
    """Without wraps the gradients are those of the float layer, but for what 8 bits change."""
    seen, grads = counts(LEARNED), []
    for int8 in (False, True):
        layer = CompressiveLayer.of(LEARNED, int8=int8)
        layer(seen).square().sum().backward()
        grads.append((layer.temporal.grad, layer.spatial.grad))
    for plain, rounded in zip(*grads, strict=True):
        assert (plain - rounded).norm() < 0.05 * plain.norm()


def test_sums_beyond_16_bits_widen_the_range():
    layer = CompressiveLayer.of(FOURIER, int8=True)
    assert layer.sum_excess(counts(FOURIER)).item() == 0
    layer.sum_excess(counts(FOURIER, peak=700)).backward()
    assert layer.temporal_range.grad < 0  # a step downhill widens
    wide = CompressiveLayer.of(FOURIER, int8=True)
    with torch.no_grad():
        wide.temporal_range += np.log(4)
    assert encode_int16(counts(FOURIER, peak=700), wide.quantised()).overflows == 0
    assert np.abs(wide.quantised().temporal).max() == 32


def test_a_trained_model_begins_one_for_the_chip_and_keeps_its_codes(tmp_path):
    plain = DepthModel(ModelConfig(design=LEARNED, sensor=SMALL), seed=3)
    config = preset("smoke", replace(plain.config, layer={"int8": True}), **FEW)
    model = DepthTraining(config, plain).model
    with torch.no_grad():
        seen = counts(LEARNED)
        difference = model.layer(seen) - plain.layer(seen)
    assert difference.norm() < 0.05 * plain.layer(seen).norm()
    with torch.no_grad():
        model.layer.temporal_range += 0.7
    save_model(model, config, {"step": 0}, tmp_path / "model.safetensors")
    again = load_model(tmp_path)[0].layer.quantised()
    assert np.array_equal(again.tensor, model.layer.quantised().tensor) and np.abs(again.temporal).max() == 63
    training = split_views(near_planes(3))
    with pytest.raises(InputError, match="in 8 bits cannot begin one without --layer int8"):
        train(preset("smoke", plain.config, **FEW), *training, tmp_path / "run", init=model)


@pytest.mark.parametrize("design", [LEARNED, FOURIER, Design("learned", (64, 1, 1), 8)], ids=lambda d: d.name)
def test_tables_in_files_hold_the_steps_that_were_trained(design, tmp_path):
    """Ranges that learned headroom leave steps below 127; exported codes were stretched to 127 again."""
    layer = CompressiveLayer.of(design, int8=True)
    with torch.no_grad():
        layer.temporal_range += 0.7
        if layer.spatial_range is not None:
            layer.spatial_range += 0.3
    trained = layer.quantised()
    assert np.abs(trained.temporal).max() == 63
    assert np.array_equal(
        np.load(write_codes(layer.coding(), tmp_path / "c.npy", int8=True)).ravel(), trained.tensor.ravel()
    )
    text = write_codes(layer.coding(), tmp_path / "c.txt", int8=True).read_text().splitlines()
    assert f"one step is {trained.temporal_scale:.9g}" in text[1]
    assert [int(v) for v in text[2].split()] == trained.temporal[0].ravel().tolist()
    again = quantised(layer.coding())
    assert (again.scale, again.spatial_scale) == (trained.scale, trained.spatial_scale)
    stretched = published_int8(layer.coding())  # another rounding, whose steps are its own
    assert stretched.steps is None and np.array_equal(quantised(stretched).tensor, quantised(replace(stretched)).tensor)


def test_what_the_chip_has_no_table_for_is_refused():
    for design in (Design("coarse", (64, 1, 1), 8), Design("learned", (16, 2, 2), 4, full=True)):
        with pytest.raises(InputError, match="int8 is for codes with a table of their own"):
            ModelConfig(design=design, sensor=SMALL, layer={"int8": True})
    with pytest.raises(InputError, match="int8 codes are made from histograms"):
        layer = CompressiveLayer.of(FOURIER, int8=True)
        layer.encode_timestamps(torch.zeros(1, dtype=torch.int64), torch.tensor([0, 1]), (64, 1, 1))


@pytest.mark.slow
def test_training_learns_headroom_for_bright_pixels(tmp_path):
    """Sums that wrap in the beginning fit in the end."""
    model = ModelConfig(design=FOURIER, sensor=SMALL, layer={"int8": True})
    few = {**FEW, "epochs": 4, "steps_per_epoch": 25}
    config = preset("smoke", model, **few, levels=((400.0, 2.0),))
    views = near_planes(4)
    train(config, *split_views(views), tmp_path)
    seen = counts(FOURIER, peak=400)
    before, after = DepthModel(model).layer.quantised(), load_model(tmp_path / "last.safetensors")[0].layer.quantised()
    assert encode_int16(seen, before).overflows > 0 == encode_int16(seen, after).overflows
    assert 16 < np.abs(after.temporal).max() < 82
