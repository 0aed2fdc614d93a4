"""Published checkpoints: built by renaming a network's tensors, imported, and compared with the network itself."""

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.utilities.parsing import AttributeDict

from csph.codes.design import Design
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig
from csph.networks.grid import published_position
from csph.networks.model import DepthModel
from csph.networks.published import soft_argmax
from csph.weights.cards import limits
from csph.weights.published import FULL, LEFT_OUT, SPATIAL, TEMPORAL, import_checkpoint
from csph.weights.torch_files import load_torch_file
from scene2spad.datasets.planes import random_planes
from scenes.errors import InputError
from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor_names import sensor_by_name

TRAIN = sensor_by_name("iccv2023-train")
DESIGNS = (
    Design("learned", (256, 2, 2), 8),
    Design("learned", (256, 2, 2), 8, full=True),
    Design("learned", (1024, 1, 1), 8),
    Design("fourier-published", (1024, 1, 1), 8),
    Design("gray-published", (256, 4, 4), 32),
    Design("coarse", (1024, 1, 1), 16),
)


def direct(design: Design, sensor: Sensor = TRAIN) -> DepthModel:
    """A published network before a design, its logits as spread as a trained one's."""
    model = DepthModel(ModelConfig(design=design, network="published", sensor=sensor), seed=5).eval()
    with torch.no_grad():
        model.network.up[-1].weight.mul_(2000)
    return model


def renamed(model: DepthModel) -> dict[str, torch.Tensor]:
    """The published names and shapes; those of the network are any, in the order of registration."""
    layer = model.layer
    if layer.temporal.ndim == 4:
        codes = {FULL: layer.temporal.unsqueeze(1)}
    else:
        codes = {TEMPORAL: layer.temporal[:, None, :, None, None]}
        codes |= {} if layer.spatial is None else {SPATIAL: layer.spatial[:, None, None]}
    network = {f"backbone_net.part{37 * j % 144}": value for j, value in enumerate(model.network.parameters())}
    return {name: value.detach() for name, value in (network | codes | {LEFT_OUT: torch.zeros(1, 1, 16, 1, 1)}).items()}


def checkpoint(path: Path, weights: dict, **more: object) -> Path:
    torch.save({"state_dict": weights, "global_step": 5194, "epoch": 6, **more}, path)
    return path


def refusal(path: Path, folder: Path, sensor: Sensor | None = None) -> str:
    with pytest.raises(InputError) as caught:
        import_checkpoint(path, folder, sensor)
    message = str(caught.value)
    assert "\n" not in message and path.name in message
    assert not folder.exists()
    return message


@pytest.mark.parametrize("design", DESIGNS, ids=lambda design: design.name)
def test_designs_are_known_by_their_tensors(design, tmp_path):
    """Full or separable by the names, a fixed code by its rows; coarse ones without zero mean, as reported."""
    model = direct(design)
    made = import_checkpoint(checkpoint(tmp_path / "a.ckpt", renamed(model)), tmp_path / "model")
    assert made.config.model == replace(model.config, grid="published")
    loaded = load_model(made.path)[0].state_dict()
    assert loaded.keys() == model.state_dict().keys()
    assert all(torch.equal(loaded[name], value) for name, value in model.state_dict().items())


@pytest.mark.parametrize("design", [DESIGNS[0], DESIGNS[1], DESIGNS[3]], ids=lambda design: design.name)
def test_an_imported_model_finds_the_depths_of_the_one_that_was_trained(design, tmp_path):
    model = direct(design)
    made = import_checkpoint(checkpoint(tmp_path / "epoch=6.ckpt", renamed(model)), tmp_path / "model")
    loaded, config, state = load_model(tmp_path / "model")
    assert made.path == tmp_path / "model/model.safetensors" and made.config == config
    assert state == {"step": 5194}
    assert made.parameters == 568278 + sum(p.numel() for p in model.layer.parameters())
    histogram = sense(random_planes(1, size=8, seed=2).transients[0], TRAIN, PhotonBudget(50, 10), seed=1)
    counts = torch.from_numpy(histogram.counts).permute(2, 0, 1)[None, None].float()
    with torch.no_grad():
        logits = model(counts)
    assert logits.std() > 0.1
    # the published decoding: weights i / 1023 of the range, and half a bin for the centre of the bin that it names
    weights = torch.linspace(0, 1, 1024, dtype=torch.float64).view(1, -1, 1, 1)
    fraction = (logits.double().softmax(1) * weights).sum(1)[0]
    expected = (1024 * fraction + 0.5) * TRAIN.bin_depth_m
    # to a hundredth of a bin: convolutions in float32 depend on how the counts lie in memory
    np.testing.assert_allclose(loaded.depth_of(histogram)[0], expected, atol=TRAIN.bin_depth_m / 100)
    ours = soft_argmax(logits)[0] * TRAIN.bin_depth_m
    assert (torch.from_numpy(loaded.depth_of(histogram)[0]) - ours).abs().max() < TRAIN.bin_depth_m
    assert "absolute depth: its labels are the published ones, for comparison with the paper" in limits(config)


def test_recorded_outputs_of_the_published_network_come_back_through_an_import(shared_data, tmp_path):
    path = shared_data.parent / "fixtures" / "backbone.npz"
    if not path.is_file():
        pytest.skip(f"no recorded outputs ({path})")
    model = direct(DESIGNS[3])
    with torch.no_grad():  # the formula that the recorded outputs belong to, tensor j of the published order, element i
        for j, parameter in enumerate(model.network.parameters()):
            i = torch.arange(parameter.numel(), dtype=torch.float64)
            fan = parameter[0].numel() if parameter.ndim > 1 else 1
            value = 0.01 * torch.cos(i + j) if parameter.ndim == 1 else 1.5 * torch.sin(0.7 * i + j) / fan**0.5
            parameter.copy_(value.view(parameter.shape))
    import_checkpoint(checkpoint(tmp_path / "formula.ckpt", renamed(model)), tmp_path / "model")
    loaded = load_model(tmp_path / "model")[0]
    with np.load(path) as recorded, torch.no_grad():
        logits = loaded.network(torch.from_numpy(recorded["x"]))
        np.testing.assert_allclose(logits, recorded["hist"], atol=1e-5 * recorded["hist"].max())
        position = published_position(soft_argmax(logits), 64)
        np.testing.assert_allclose(position, 64 * recorded["depth"][:, 0] + 0.5, rtol=1e-5)


def test_a_spatial_factor_of_one_pixel_goes_into_the_temporal_one(tmp_path):
    model = direct(DESIGNS[2])
    factor = torch.linspace(-2, 2, 8)
    weights = renamed(model) | {SPATIAL: factor.view(8, 1, 1, 1, 1)}
    made = import_checkpoint(checkpoint(tmp_path / "a.ckpt", weights), tmp_path / "model")
    assert made.config.model.design == Design("learned", (1024, 1, 1), 8)
    torch.testing.assert_close(load_model(made.path)[0].layer.temporal, model.layer.temporal * factor[:, None])


def test_what_a_trainer_keeps_beside_its_weights_is_left_out(tmp_path):
    """Settings, callbacks and paths are objects of other libraries, in published checkpoints as in others."""
    settings = AttributeDict(lr=1e-3, folder=Path("out"), nested=AttributeDict(k=32))
    more = {
        "hyper_parameters": settings,
        "callbacks": {ModelCheckpoint: {"best_model_path": "x.ckpt"}},
        "hparams_type": AttributeDict,
        "scores": [np.float64(3), np.arange(3), torch.nn.Linear(2, 2)],
    }
    path = checkpoint(tmp_path / "whole.ckpt", renamed(direct(DESIGNS[2])), **more)
    with pytest.raises(InputError, match="no checkpoint of tensors alone"):
        load_torch_file(path)
    made = import_checkpoint(path, tmp_path / "model")
    assert load_model(made.path)[2] == {"step": 5194}


class _Writes:
    """What a pickle can do to its reader."""

    def __init__(self, call: object, *values: object) -> None:
        self.call, self.values = call, values

    def __reduce__(self) -> tuple:
        return self.call, self.values


def test_no_code_of_a_checkpoint_runs(tmp_path):
    victim = tmp_path / "victim"
    weights = renamed(direct(DESIGNS[2]))
    for number, call in enumerate((_Writes(open, str(victim), "w"), _Writes(eval, f"open({str(victim)!r}, 'w')"))):
        path = checkpoint(tmp_path / f"{number}.ckpt", weights, hyper_parameters=call)
        import_checkpoint(path, tmp_path / f"model{number}")
        assert not victim.exists()
    path = checkpoint(tmp_path / "system.ckpt", weights, hyper_parameters=_Writes(os.system, f"touch {victim}"))
    assert "no checkpoint of tensors alone" in refusal(path, tmp_path / "model")
    assert not victim.exists()
    pickle.dump({"state_dict": {}}, (tmp_path / "plain.ckpt").open("wb"))
    assert "no checkpoint, or a damaged one" in refusal(tmp_path / "plain.ckpt", tmp_path / "model")


NAN, WHOLE = torch.full((8, 1, 256, 1, 1), torch.nan), torch.zeros(8, 1, 256, 1, 1, dtype=torch.int64)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"backbone_net.part0": None}, "143 tensors backbone_net.*, the published network has 144"),
        ({"backbone_net.theta": torch.zeros(3)}, "145 tensors backbone_net.*, the published network has 144"),
        ({"backbone_net.part37": torch.zeros(3)}, "tensor backbone_net.part37 is (3,), expected (2,) at the place of"),
        ({"csph_layer.weight": torch.zeros(3)}, "csph_layer.weight is of no published compressive model"),
        ({SPATIAL: torch.zeros(7, 1, 1, 2, 2)}, "Cmat_xydim is (7, 1, 1, 2, 2), expected (8, 1, 1, any, any)"),
        ({TEMPORAL: torch.zeros(8, 256)}, "Cmat_tdim is (8, 256), expected (any, 1, any, 1, 1)"),
        ({TEMPORAL: None}, "expected one coding tensor"),
        ({TEMPORAL: None, SPATIAL: None}, "expected one coding tensor"),
        ({FULL: torch.zeros(8, 1, 256, 2, 2)}, "expected one coding tensor"),
        ({TEMPORAL: NAN}, "tensor csph3d_layer.Cmat_tdim holds NaN or infinite weights"),
        ({TEMPORAL: WHOLE}, "Cmat_tdim is no tensor of weights"),
        ({TEMPORAL: torch.zeros(8, 1, 200, 1, 1)}, "blocks of 200 bins do not divide the sensor's 1024"),
        ({TEMPORAL: torch.zeros(1).expand(8, 1, 2**30, 1, 1)}, "is larger than the file"),
    ],
)
def test_other_checkpoints_are_refused_in_one_line(changes, message, tmp_path):
    weights = renamed(direct(DESIGNS[0])) | changes
    kept = {name: value for name, value in weights.items() if value is not None}
    assert message in refusal(checkpoint(tmp_path / "other.ckpt", kept), tmp_path / "model")


def test_nothing_is_overwritten_and_other_files_are_named(tmp_path):
    path = checkpoint(tmp_path / "a.ckpt", renamed(direct(DESIGNS[0])))
    torch.save([1, 2], tmp_path / "list.ckpt")
    assert "holds no state_dict" in refusal(tmp_path / "list.ckpt", tmp_path / "model")
    assert "do not divide the sensor's 1008" in refusal(path, tmp_path / "model", replace(TRAIN, bins=1008))
    assert "1000 bins, expected a multiple of 16" in refusal(path, tmp_path / "model", replace(TRAIN, bins=1000))
    made = import_checkpoint(path, tmp_path / "model")
    before = made.path.read_bytes()
    with pytest.raises(InputError, match=r"model\.safetensors: exists"):
        import_checkpoint(path, tmp_path / "model")
    assert made.path.read_bytes() == before
    assert "no checkpoint" in refusal(made.path, tmp_path / "again")
    assert "not found" in refusal(tmp_path / "none.ckpt", tmp_path / "again")
    path.write_bytes(path.read_bytes()[:-2000])
    assert "damaged" in refusal(path, tmp_path / "again")
