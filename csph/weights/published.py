"""Checkpoints of the published code (ICCV 2023) as models of ours.

    backbone_net.*              144 tensors in the order of `csph.networks.published.DeepBoosting`'s parameters
    csph3d_layer.Cmat_tdim      (K, 1, Mt, 1, 1) temporal factor
    csph3d_layer.Cmat_xydim     (K, 1, 1, Mr, Mc) spatial factor
    csph3d_layer.Cmat_txydim    (K, 1, Mt, Mr, Mc) full tensor, instead of the two
    csph3d_layer.irf_weights    pulse of a switch that no published model has on: left out

The network decodes bin i of T as i/(T - 1) of the range, and its labels are whole bins: the model has the published
grid (`csph.networks.grid`). Weights are float32 as they were; nothing is trained again.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from csph.codes.design import Design
from csph.codes.temporal import FIXED_CODES, temporal_code
from csph.networks.checkpoint import save_model
from csph.networks.config import ModelConfig, TrainConfig, preset
from csph.networks.model import DepthModel
from csph.weights.torch_files import load_torch_file
from scenes.errors import InputError, require
from spad.sensor.model import PRESETS, Sensor

NETWORK, LAYER = "backbone_net.", "csph3d_layer."
TEMPORAL, SPATIAL, FULL = f"{LAYER}Cmat_tdim", f"{LAYER}Cmat_xydim", f"{LAYER}Cmat_txydim"
LEFT_OUT = f"{LAYER}irf_weights"
TRAINED_ON = "iccv2023-train"  # sensor of the published training set, whose pulse its Gray codes follow
SAME_CODE = 1e-4  # largest difference of rows that are the same code


class Imported(NamedTuple):
    """A model that was imported, what it is, and where it lies."""

    config: TrainConfig
    parameters: int
    path: Path


def import_checkpoint(path: Path, folder: Path, sensor: Sensor | None = None) -> Imported:
    """Write a published checkpoint as `folder`/model.safetensors, which `csph.networks.checkpoint.load_model` reads.

    `sensor` (default: that of the published training set) is the one whose histograms the model is to take: what it
    learned of pulses was in bins, and the paper tests it on the reference sensor. Nothing but tensors and plain values
    is unpickled. Raises InputError in one line for a file that is no such checkpoint, another design's, damaged or not
    finite, a sensor whose bins its blocks do not divide, and a folder that holds a model already.
    """
    path, target = Path(path), Path(folder) / "model.safetensors"
    require(not target.exists(), f"{target}: exists; choose another folder")
    contents = load_torch_file(path, foreign=True)
    try:
        weights = _tensors(contents, path.stat().st_size)
        temporal, spatial = _coding(weights)
        design = _design(temporal, spatial)
        model = ModelConfig(design=design, network="published", sensor=sensor or PRESETS[TRAINED_ON], grid="published")
        data = {"imported": path.name, "imported_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        config = preset("paper", model, data=data)
        made = DepthModel(model)
        parts = {"layer.temporal": temporal} | ({} if spatial is None else {"layer.spatial": spatial})
        made.load_state_dict(parts | _network(weights, made))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    step = contents.get("global_step") if isinstance(contents, dict) else None
    target.parent.mkdir(parents=True, exist_ok=True)
    save_model(made, config, {"step": step} if isinstance(step, int) else {}, target)
    return Imported(config, made.parameters_count, target)


def _tensors(contents: object, size: int) -> dict[str, Tensor]:
    """Return the weights of a file of `size` bytes in their order.

    Raises InputError for others than a published compressive model's.
    """
    weights = contents.get("state_dict") if isinstance(contents, dict) else None
    if not isinstance(weights, dict):
        raise InputError("holds no state_dict, it is no checkpoint of the published code")
    known = {TEMPORAL, SPATIAL, FULL, LEFT_OUT}
    left = size
    for name, value in weights.items():
        ours = isinstance(name, str) and (name.startswith(NETWORK) or name in known)
        require(ours, f"tensor {str(name)[:80]} is of no published compressive model ({NETWORK}*, {LAYER}Cmat_*)")
        require(isinstance(value, Tensor) and value.is_floating_point(), f"{name} is no tensor of weights")
        left -= value.numel() * value.element_size()
        require(left >= 0, f"tensor {name} has shape {tuple(value.shape)}, more than the file of {size} bytes holds")
        require(bool(value.float().isfinite().all()), f"tensor {name} holds NaN or infinite weights")
    return {name: value.float() for name, value in weights.items()}


def _coding(weights: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
    """Return the temporal part, (K, Mt) or full (K, Mt, Mr, Mc), and the spatial one (K, Mr, Mc), if any.

    Over single pixels the spatial factor is one number a code, and goes into the temporal one.
    """
    full, temporal, spatial = (weights.get(name) for name in (FULL, TEMPORAL, SPATIAL))
    alone = f"expected one coding tensor: {FULL}, or {TEMPORAL} with or without {SPATIAL}"
    if full is not None:
        require(temporal is None and spatial is None, alone)
        _check_shape(FULL, full, (None, 1, None, None, None))
        part = full[:, 0]
        return (part if part.shape[2:].numel() > 1 else part[..., 0, 0]), None
    if temporal is None:
        raise InputError(alone)
    _check_shape(TEMPORAL, temporal, (None, 1, None, 1, 1))
    temporal = temporal[:, 0, :, 0, 0]
    if spatial is None:
        return temporal, None
    _check_shape(SPATIAL, spatial, (len(temporal), 1, 1, None, None))
    spatial = spatial[:, 0, 0]
    return (temporal, spatial) if spatial[0].numel() > 1 else (temporal * spatial[:, 0], None)


def _check_shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    shape = tuple(tensor.shape)
    fits = len(shape) == len(expected) and all(e in (None, n) and n > 0 for n, e in zip(shape, expected, strict=True))
    message = ", ".join("any" if n is None else str(n) for n in expected)
    require(fits, f"tensor {name} is {shape}, expected ({message})")


def _design(temporal: Tensor, spatial: Tensor | None) -> Design:
    """Return the design of a coding tensor; its code is the fixed one that its rows are, else learned."""
    codes, bins = temporal.shape[:2]
    if temporal.ndim == 4:
        _, mt, mr, mc = temporal.shape
        return Design("learned", (mt, mr, mc), codes, full=True)
    rows, columns = (1, 1) if spatial is None else spatial.shape[1:]
    return Design(_code(temporal), (bins, rows, columns), codes)


def _code(temporal: Tensor) -> str:
    codes, bins = temporal.shape
    for name in FIXED_CODES:
        try:
            fixed = temporal_code(name, codes, bins, PRESETS[TRAINED_ON])
        except InputError:  # K does not fit that code
            continue
        if bool(((fixed - temporal).abs() < SAME_CODE).all()):
            return name
    return "learned"


def _network(weights: dict[str, Tensor], model: DepthModel) -> dict[str, Tensor]:
    """Rename the network's tensors by their place. Raises InputError where number or shapes are not the published."""
    theirs = [name for name in weights if name.startswith(NETWORK)]
    ours = dict(model.network.named_parameters())
    require(len(theirs) == len(ours), f"{len(theirs)} tensors {NETWORK}*, the published network has {len(ours)}")
    for name, (own, expected) in zip(theirs, ours.items(), strict=True):
        has, should = tuple(weights[name].shape), tuple(expected.shape)
        require(has == should, f"tensor {name} is {has}, expected {should} at the place of network.{own}")
    return {f"network.{own}": weights[name] for own, name in zip(ours, theirs, strict=True)}
