"""Arguments of the wrong kind end in one line that names them, and numpy's numbers become Python's own."""

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.layer import CompressiveLayer, LayerOptions, make_coding
from csph.networks.checkpoint import save_model
from csph.networks.config import ModelConfig, TrainConfig, preset
from csph.networks.model import DepthModel
from csph.training.beginning import WeightsOf
from csph.training.loop import train
from csph.training.views import Views, read_views
from scene2spad.datasets.planes import random_planes
from scenes import InputError
from spad.measurements.histogram import Histogram

DESIGN = Design("learned", (64, 2, 2), 8)
MODEL = ModelConfig(design=DESIGN)
COUNTS = np.zeros((1, 1, 1024, 4, 4), np.int64)
WORDS = np.array(["a", "b"])  # whose comparison with a word is no truth value
PLANES = random_planes(1, size=16, seed=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: DepthModel(MODEL)(COUNTS), r"expected a Tensor \(`torch.from_numpy` makes one\), not ndarray"),
        (lambda: DepthModel(ModelConfig(front="counts"))(COUNTS), "counts: expected a Tensor .* not ndarray"),
        (lambda: DepthModel(MODEL).depth_of_codes(COUNTS), "expected a Tensor .* not ndarray"),
        (lambda: CompressiveLayer.of(DESIGN)(COUNTS), "expected a Tensor .* not ndarray"),
        (lambda: CompressiveLayer.of(DESIGN).encode([1, 2]), "expected a Tensor .* not list"),
        (lambda: CompressiveLayer.of(DESIGN).decode(COUNTS), "expected a Tensor .* not ndarray"),
        (lambda: CompressiveLayer(make_coding(DESIGN), learned="temporal"), r"learned 'temporal', expected names"),
        (lambda: CompressiveLayer.of("learned"), "expected a Design, not str"),
        (lambda: CompressiveLayer.of(DESIGN, int8="yes"), "layer: int8 'yes', expected True or False"),
        (lambda: CompressiveLayer.of(DESIGN, spatial_start="flat"), "spatial_start 'flat' is unknown, expected one of"),
        (lambda: make_coding(DESIGN, seed=1.5), "seed 1.5, expected a whole number"),
        (lambda: CompressiveLayer(make_coding(DESIGN), learned=[1]), r"learned \[1\], expected names of parts"),
        (lambda: CompressiveLayer.of(DESIGN, foo=True), "layer foo: is unknown, expected zero_mean"),
        (lambda: make_coding(DESIGN, spatial_start=WORDS), "spatial_start array.* is unknown, expected one of uniform"),
        (lambda: LayerOptions(keep_mean=1), "layer: keep_mean 1, expected True or False"),
        (lambda: DepthModel(DESIGN), "DepthModel: expected a ModelConfig, not Design"),
        (lambda: DepthModel(MODEL, seed="a"), "seed 'a', expected a whole number"),
    ],
)
def test_layers_and_models_take_what_they_say(call, message):
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ModelConfig(design="learned"), r"design 'learned', expected a Design \(`Design.named` makes one"),
        (lambda: ModelConfig(design=DESIGN, sensor="reference"), "sensor 'reference', expected a Sensor"),
        (
            lambda: ModelConfig(design=DESIGN, layer={"keep_men": True}),
            "layer keep_men: is unknown; did you mean 'keep",
        ),
        (lambda: ModelConfig(design=DESIGN, layer={3: True}), "layer {3: True}: expected switches by name"),
        (
            lambda: Design("learned", (64, 2, 2), 8, spatial_learned="temporal"),
            "spatial_learned 'temporal', expected T",
        ),
        (lambda: Design("learned", (64, 2, 2), 8, full="yes"), "full 'yes', expected True or False"),
        (lambda: Design("learned", (64, 2, 2), 8, zero_mean="yes"), "zero_mean 'yes', expected True, False or None"),
        (lambda: Design("learned", 64, 8), "block 64: expected three positive whole numbers"),
        (lambda: Design("learned", (64, True, 2), 8), "block .*: expected three positive whole numbers"),
        (lambda: Design(3), "design 3 is unknown, expected one of learned"),
        (lambda: Design.named(None, (64, 2, 2), codes=8), "design None: expected CODE or CODE.learned"),
        (lambda: Design(WORDS), "design array.* is unknown, expected one of learned"),
        (lambda: Design.named("learned", (64, 2, 2), compression="a"), "compression ratio 'a', expected a number"),
        (lambda: ModelConfig(front=WORDS), "front array.* is unknown, expected one of codes"),
        (lambda: preset("smoke", "learned"), "preset: model 'learned', expected a ModelConfig"),
        (lambda: preset(["smoke"], MODEL), r"preset \['smoke'\] is unknown, expected one of smoke"),
        (lambda: TrainConfig.from_dict({"model": "abc"}), "its configuration cannot be read"),
        (lambda: TrainConfig(model="learned"), "training: model 'learned', expected a ModelConfig"),
    ],
)
def test_configurations_of_models_are_checked(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epochs": 2.5}, "training: epochs 2.5, expected a whole number"),
        ({"batch": "8"}, "batch '8', expected a whole number"),
        ({"seed": True}, "seed True, expected a whole number"),
        ({"warmup": 1.5}, "warmup 1.5, expected a whole number"),
        ({"rate": "fast"}, "rate 'fast', expected a number"),
        ({"tv_weight": None}, "tv_weight None, expected a number"),
        ({"preset": 3}, "preset 3, expected text"),
        ({"data": 3}, "data 3, expected entries by name"),
        ({"weights": 3}, "weights 3, expected a number for each training set"),
        ({"weights": ("a",)}, "set weight 'a', expected a number"),
        ({"levels": 5}, "level 5, expected pairs of signal and background photons"),
        ({"levels": (10.0, 10.0)}, "level 10.0, expected pairs"),
        ({"levels": ((10.0, "a"),)}, r"level \(10.0, 'a'\), expected pairs"),
        ({"levels": ((10.0, math.nan),)}, "nan.*, expected pairs .* finite and not negative"),
        ({"levels": ((0, 10.0),)}, r"level \(0, 10.0\), expected pairs .* signal above 0"),
        ({"levels": ((True, 2),)}, r"level \(True, 2\), expected pairs"),
        ({"levels": ((-1.0, 10.0),)}, r"level \(-1.0, 10.0\), expected pairs"),
    ],
)
def test_configurations_of_trainings_are_checked(change, message):
    with pytest.raises(InputError, match=message) as caught:
        TrainConfig(model=MODEL, **change)
    assert "\n" not in str(caught.value)


def test_numbers_of_numpy_become_those_that_json_holds(tmp_path):
    """They were kept, and the checkpoint could not be written after the training."""
    design = Design("fourier", [np.int64(64), 1, 1], np.int64(8))
    config = TrainConfig(model=ModelConfig(design=design), epochs=np.int64(2), rate=np.float32(0.5), levels=[(10, 10)])
    assert design == Design("fourier", (64, 1, 1), 8) and hash(design) == hash(Design("fourier", (64, 1, 1), 8))
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert design == Design("fourier", np.array([64, 1, 1]), 8)
    counts_model, array = ModelConfig(front="counts"), np.array([[1, 2.0]])
    assert preset("smoke", counts_model, levels=array) == preset("smoke", counts_model, levels=((1, 2),))
    model = DepthModel(config.model, seed=np.int64(3))
    save_model(model, config, {}, tmp_path / "model.safetensors")
    counts = torch.from_numpy(COUNTS)
    assert torch.equal(model(counts), model(counts.float()))


@pytest.mark.parametrize(
    ("training", "validation", "message"),
    [
        ([], PLANES, r"train: training \[\], expected Views of one set or a list of several"),
        (PLANES, [], r"train: validation \[\], expected Views"),
        (None, PLANES, "train: training None, expected Views"),
        ("rooms", PLANES, "train: training 'rooms', expected Views"),
        (["rooms"], PLANES, "train: training: expected a Views of `read_views`, not str"),
        (PLANES, PLANES._replace(transients=(), scenes=()), "train: validation: a set has no view"),
        (PLANES._replace(scenes=()), PLANES, r"train: training: Views of \d+ transients and 0 names of scenes"),
    ],
)
def test_trainings_without_sets_are_refused(training, validation, message, tmp_path):
    with pytest.raises(InputError, match=message):
        train(TrainConfig(model=MODEL), training, validation, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_is_no_path_and_no_histogram_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"^train: folder: expected a path, not NoneType$"):
        train(TrainConfig(model=MODEL), PLANES, PLANES, None)
    with pytest.raises(InputError, match=r"^read_views: expected a path, not NoneType$"):
        read_views(None)
    for refused in (DepthModel(MODEL).estimate, DepthModel(MODEL).check_histogram):
        with pytest.raises(InputError, match=r"^DepthModel: expected a Histogram of `sense`.*, not ndarray$"):
            refused(COUNTS)


def test_a_network_takes_histograms_of_its_sensors_period_alone():
    """With as many bins of the same width, of which the period has twice as many: a circle of bins is none there."""
    sensor = MODEL.sensor
    own, gated = (Histogram.from_counts(COUNTS[0, 0].T, one) for one in (sensor, replace(sensor, period_s=2e-7)))
    DepthModel(MODEL).check_histogram(own)
    with pytest.raises(InputError, match=r"another sensor or pulse:.* \(1024 of 1024 bins .*, .* \(1024 of 2048 bins"):
        DepthModel(MODEL).check_histogram(gated)


@pytest.mark.parametrize("init", ["none-mixed-s0", WeightsOf("none-mixed-s0")])
def test_a_training_begins_with_a_model_and_nothing_else(init, tmp_path):
    with pytest.raises(InputError, match="train: init: expected a DepthModel of `load_model`, not str"):
        train(TrainConfig(model=MODEL), PLANES, PLANES, tmp_path / "run", init=init)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("design", [Design("learned", (16, 2, 2), 4), Design("learned", (16, 1, 1), 4)])
def test_torch_functions_of_a_layer_are_as_documented(design):
    """Other weights and first derivatives; nothing batched, nothing derived twice."""
    layer = CompressiveLayer.of(design).double()
    counts = torch.rand(1, 1, 16, 2, 2, dtype=torch.float64)
    weights = {name: part.detach().square() for name, part in layer.named_parameters()}
    moved = torch.func.functional_call(layer, weights, (counts,))
    other = CompressiveLayer.of(design, seed=1).double()
    other.load_state_dict(weights, strict=False)
    assert torch.equal(moved, other(counts)) and not torch.equal(moved, layer(counts))
    slope = torch.autograd.functional.jacobian(layer, counts).reshape(64, 64)
    step, width = torch.rand_like(counts), 1e-6
    numeric = (layer(counts + width * step) - layer(counts - width * step)) / (2 * width)
    torch.testing.assert_close(slope @ step.flatten(), numeric.detach().flatten(), rtol=1e-5, atol=1e-7)
    for transform in (torch.func.vmap(layer), torch.func.jacrev(layer)):
        with pytest.raises(RuntimeError):
            transform(counts[None])
    with pytest.raises(RuntimeError):
        torch.autograd.functional.hessian(lambda one: layer(one).square().sum(), counts, strict=True)


@pytest.mark.parametrize(
    ("transients", "scenes", "message"),
    [
        (("a",), ("b",), r"Views: transients\[0\]: expected a Transient, not str"),
        (PLANES.transients[:1], (), "Views: Views of 1 transients and 0 names of scenes, expected as many"),
        ((), (), "Views: a set has no view"),
        (PLANES.transients[0], ("a",), "Views: transients: expected a list of Transient, not Transient"),
        (PLANES.transients[:1], (3,), r"Views: scenes\[0\]: expected a str, not int"),
        (PLANES.transients[:1], "a", "Views: scenes: expected a list of str, not str"),
    ],
)
def test_views_are_transients_and_as_many_names(transients, scenes, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        Views(transients, scenes)


def test_views_stay_a_named_tuple():
    again = pickle.loads(pickle.dumps(PLANES))
    assert type(again) is Views and len(again.transients) == len(again.scenes)
    assert again[1] == PLANES.scenes and repr(PLANES).startswith("Views(transients=(Transient(")
