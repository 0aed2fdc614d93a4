"""Checkpoints that are damaged, foreign or not finite: one line that names the file and the tensor."""

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save

from csph.codes.design import Design
from csph.networks.checkpoint import KIND, load_model, save_model, tensors_sha256
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from csph.training.resume import claim_run
from csph.weights.torch_files import load_torch_file
from scene2spad.studies.tensors import coding_of
from scenes.errors import InputError
from scenes.files import ATTRIBUTE, seal
from spad.sensor.model import Sensor

CONFIG = TrainConfig(
    model=ModelConfig(design=Design.named("learned", (16, 2, 2), codes=8), sensor=Sensor(bins=64)), crop=8
)


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    save_model(DepthModel(CONFIG.model), CONFIG, {"step": 1}, tmp_path / "model.safetensors")
    return tmp_path / "model.safetensors"


def resealed(path: Path, change=lambda weights: None, config: object = None) -> Path:
    """The checkpoint with other weights or another configuration, its SHA-256 made to fit."""
    weights = load_file(path)
    change(weights)
    meta = {"config": CONFIG.to_dict() if config is None else config, "state": {"step": 1}}
    path.write_bytes(save(weights, {ATTRIBUTE: seal(meta, KIND, tensors_sha256(weights))}))
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_model(path)
    message = str(caught.value)
    assert "\n" not in message and path.name in message
    return message


def _with(value: float):
    def change(weights: dict) -> None:
        weights["layer.temporal"][3, 5] = value

    return change


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused_by_tensor(checkpoint, value):
    assert "tensor layer.temporal holds NaN or infinite" in refusal(resealed(checkpoint, _with(value)))


def test_bfloat16_weights_are_read_as_float32(checkpoint):
    expected = load_file(checkpoint)["layer.temporal"].bfloat16().float()

    def rounded(weights: dict) -> None:
        weights |= {name: value.bfloat16() for name, value in weights.items() if value.is_floating_point()}

    model, _, _ = load_model(resealed(checkpoint, rounded))
    assert model.layer.temporal.dtype == torch.float32 and torch.equal(model.layer.temporal.detach(), expected)


def test_bfloat16_weights_under_another_seal_are_refused(checkpoint):
    weights = {name: value.bfloat16() for name, value in load_file(checkpoint).items()}
    meta = {"config": CONFIG.to_dict(), "state": {"step": 1}}
    checkpoint.write_bytes(save(weights, {ATTRIBUTE: seal(meta, KIND, "0" * 64)}))
    assert "SHA-256" in refusal(checkpoint)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda weights: weights.pop("layer.spatial"), "tensor layer.spatial is missing"),
        (lambda weights: weights.update(extra=torch.ones(2)), "tensor extra is one too many"),
        (
            lambda weights: weights.update({"layer.temporal": torch.ones(8, 17)}),
            "tensor layer.temporal is (8, 17), expected (8, 16)",
        ),
        (
            lambda weights: weights.update({"layer.temporal": torch.ones(8, 16, dtype=torch.int32)}),
            "tensor layer.temporal holds torch.int32",
        ),
    ],
)
def test_weights_that_do_not_fit_the_design_are_refused_by_tensor(checkpoint, change, words):
    assert words in refusal(resealed(checkpoint, change))


def _config(**changes: object) -> dict:
    """The configuration as JSON has it, entries of the model's design or sensor changed by "part.name"."""
    config = json.loads(json.dumps(CONFIG.to_dict()))
    for key, value in changes.items():
        *parts, name = key.split("__")
        at = config
        for part in parts:
            at = at[part]
        at[name] = value
    return config


@pytest.mark.parametrize(
    "config",
    [
        [],
        "text",
        _config(model=None),
        _config(epochs="3"),
        _config(levels=7),
        _config(unknown=1),
        _config(model__design__block=[16, 2]),
        _config(model__design__block="abc"),
        _config(model__design__block=[16, 1 << 20, 1 << 20]),
        _config(model__design__codes=1 << 40),
        _config(model__design={}),
        _config(model__sensor__bins=1 << 40),
        _config(model__sensor__bin_width_s=0.0),
        _config(model__sensor__bins=None),
        _config(model__sensor__pulse=None),
        _config(model__sensor__pulse={"sigma_s": float("nan"), "tail_s": 0.0}),
        _config(model__sensor__pulse={"samples": ["a"], "sample_s": 1e-11}),
        _config(model__sensor__jitter="wide"),
        _config(model__layer={"none": True}),
        _config(model__layer=3),
    ],
)
def test_a_damaged_configuration_is_refused(checkpoint, config):
    refusal(resealed(checkpoint, config=config))


def test_a_deep_header_and_a_pipe_are_refused(checkpoint, tmp_path):
    checkpoint.write_bytes(save({"a": torch.ones(1)}, {ATTRIBUTE: "[" * 100_000}))
    refusal(checkpoint)
    os.mkfifo(tmp_path / "pipe.safetensors")
    assert "pipe" in refusal(tmp_path / "pipe.safetensors")


def test_a_configuration_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "config.json").write_bytes(b"\xff\xfe{")
    with pytest.raises(InputError, match=r"config\.json: is not text"):
        claim_run(tmp_path, CONFIG)


# --- Files of torch.save ---------------------------------------------------------------------------------------------


def test_no_flipped_byte_of_a_ckpt_is_accepted_with_other_numbers(tmp_path):
    path, rng = tmp_path / "a.ckpt", np.random.default_rng(4)
    good = {"state_dict": {"layer.temporal": torch.randn(4, 16), "other": torch.ones(3)}, "epoch": 2}
    torch.save(good, path)
    content = path.read_bytes()
    for at in rng.choice(len(content), 300, replace=False):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            tensor = coding_of(path).temporal
        except InputError as error:
            assert "a.ckpt" in str(error) and "\n" not in str(error)
        else:
            assert torch.equal(tensor, good["state_dict"]["layer.temporal"])


@pytest.mark.parametrize("left", [0, 10, 300, -1])
def test_a_ckpt_that_was_cut_short_is_refused(tmp_path, left):
    torch.save({"temporal": torch.randn(4, 16)}, tmp_path / "a.ckpt")
    (tmp_path / "a.ckpt").write_bytes((tmp_path / "a.ckpt").read_bytes()[:left])
    with pytest.raises(InputError, match=r"a\.ckpt"):
        coding_of(tmp_path / "a.ckpt")


def test_a_ckpt_of_code_or_without_checksums_or_a_pipe_is_refused(tmp_path):
    torch.save({"temporal": Path("x")}, tmp_path / "code.ckpt")
    (tmp_path / "bare.ckpt").write_bytes(pickle.dumps({"temporal": 1}))
    os.mkfifo(tmp_path / "pipe.ckpt")
    for name, words in (("code", "tensors alone"), ("bare", "no checkpoint"), ("pipe", "pipe"), ("gone", "not found")):
        with pytest.raises(InputError, match=rf"{name}\.ckpt.*{words}"):
            load_torch_file(tmp_path / f"{name}.ckpt")


def test_a_ckpt_of_few_elements_repeated_beyond_memory_is_refused(tmp_path):
    path = tmp_path / "model.ckpt"
    torch.save({"state_dict": {"temporal": torch.ones(1).expand(8, 1 << 40)}}, path)
    with pytest.raises(
        InputError, match=r"model\.ckpt: a tensor of shape \(8, 1099511627776\) is larger than the file"
    ):
        coding_of(path)


def test_a_ckpt_of_codes_that_are_not_finite_is_refused(tmp_path):
    torch.save({"temporal": torch.full((4, 16), torch.nan)}, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match="temporal is no tensor of finite numbers"):
        coding_of(tmp_path / "a.ckpt")
