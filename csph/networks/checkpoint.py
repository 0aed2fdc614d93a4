"""The checkpoint of a `DepthModel`: a safetensors file, with configuration and state of training in its header."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from torch import Tensor, nn

from csph.codes.design import OWN
from csph.codes.tensor import CodingTensor
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from scenes.errors import InputError, require
from scenes.files import ATTRIBUTE, check_seal, open_seal, seal, whole_file
from scenes.io.inputs import regular_file
from scenes.json_types import JsonObject
from scenes.limits import require_memory

KIND = "network"


def tensors_sha256(weights: dict[str, Tensor]) -> str:
    """Return SHA-256 over names, shapes and values of tensors by their names."""
    sha = hashlib.sha256()
    for name in sorted(weights):
        array = weights[name].detach().cpu().contiguous()
        sha.update(f"{name}{array.dtype}{tuple(array.shape)}".encode())
        sha.update(array.view(-1).view(torch.uint8).numpy().tobytes())  # as bytes: numpy knows no bfloat16
    return sha.hexdigest()


def weights_sha256(model: nn.Module) -> str:
    """Return SHA-256 over names, shapes and values of all weights."""
    return tensors_sha256(model.state_dict())


def save_model(model: DepthModel, config: TrainConfig, state: JsonObject, path: Path, *, half: bool = False) -> None:
    """Write weights as safetensors, whole or not at all; configuration and `state` (step, validation) in its header.

    `half` keeps them in float16, in half the space; `load_model` gives float32 again, 11 bits of each. Raises
    InputError for a network of a user's own, which no configuration names.
    """
    from safetensors.torch import save

    nameless = "its network is no registered one: keep its state_dict, or register it as docs/extending.md says"
    require(not model.has_own_network, f"{path}: {nameless}")
    weights = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    weights = {name: value.half() for name, value in weights.items()} if half else weights
    header = seal({"config": config.to_dict(), "state": state}, KIND, tensors_sha256(weights))
    with whole_file(path) as beside:
        beside.write_bytes(save(weights, {ATTRIBUTE: header}))


def checkpoint_file(path: Path) -> Path:
    """Return the checkpoint that a path names: the file, or `model.safetensors` in the folder of a run."""
    path = Path(path)
    return regular_file(path / "model.safetensors" if path.is_dir() else path)


def load_model(path: Path) -> tuple[DepthModel, TrainConfig, JsonObject]:
    """Return a model as it was saved, in evaluation mode, its configuration, and the state it was saved in.

    Weights in float16 or bfloat16 become float32. Raises InputError in one line for a missing, foreign or altered
    file, a newer schema, or weights of another design or that are not finite.
    """
    from safetensors import SafetensorError, safe_open

    path = checkpoint_file(path)
    try:
        with safe_open(path, "pt") as file:
            header = (file.metadata() or {}).get(ATTRIBUTE)
            if header is None:
                raise InputError("is no checkpoint of scene2spad")
            meta, sha256 = open_seal(header, KIND)
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        meta = check_seal(meta, sha256, tensors_sha256(weights))
        config, state = TrainConfig.from_dict(meta["config"]), meta["state"]
        require(isinstance(state, dict), f"its state is a {type(state).__name__}, expected an object")
        _check_design(config.model, sum(value.numel() for value in weights.values()))
        model = DepthModel(config.model, config.seed, own=_stored_codes(config.model, weights))
        _check_weights(weights, model)
        model.load_state_dict(weights)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (SafetensorError, OSError, KeyError, ValueError, TypeError, ArithmeticError) as error:
        raise InputError(f"{path}: not a readable checkpoint ({' '.join(str(error).split())[:120]})") from None
    return model.eval(), config, state


def _check_design(config: ModelConfig, stored: int) -> None:
    """Raise InputError for a coding tensor of more numbers than the file holds, before it is made."""
    design = config.design
    if design is None:
        return
    depth, pixels = design.block[0], design.size // design.block[0]
    numbers = design.codes * (design.size if design.full else depth + (pixels if pixels > 1 else 0))
    if config.layer.get("pulse_in_codes") or config.layer.get("pulse_in_decoder"):
        require_memory(24 * depth**2, f"the pulse at every one of {depth} bins")
    require(numbers <= stored, f"its design has {numbers} code entries, the file holds {stored} numbers")


def _stored_codes(config: ModelConfig, weights: dict[str, Tensor]) -> CodingTensor | None:
    """Return own codes, which a checkpoint holds as it does all fixed codes; None of other designs."""
    if config.design is None or config.design.code != OWN:
        return None
    require("layer.temporal" in weights, f"its weights are of another design than {config.name}: it holds no codes")
    return CodingTensor(config.design.name, weights["layer.temporal"])


def _check_weights(weights: dict[str, Tensor], model: DepthModel) -> None:
    """Raise InputError that names the first tensor that is missing, too many, of another shape or kind, or not
    finite."""
    expected = model.state_dict()
    of = f"of another design than {model.config.name}:"
    for name in sorted({*expected, *weights}):
        require(name in weights, f"its weights are {of} tensor {name} is missing")
        require(name in expected, f"its weights are {of} tensor {name} is one too many")
        has, should = weights[name], expected[name]
        shapes = f"{tuple(has.shape)}, expected {tuple(should.shape)}"
        require(has.shape == should.shape, f"its weights are {of} tensor {name} is {shapes}")
        alike = has.is_floating_point() == should.is_floating_point()
        require(alike, f"tensor {name} holds {has.dtype}, expected {should.dtype}")
        require(bool(has.isfinite().all()), f"tensor {name} holds NaN or infinite weights")
