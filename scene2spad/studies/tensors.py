"""`study tensors`: the temporal part of coding tensors as matrices and as functions (supplement, Figures 1 and 17)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.figure import SubFigure
from torch import Tensor

from csph import CodingTensor, Design, make_coding
from csph.codes.files import read_codes
from csph.weights.cards import checkpoint_of, model_coding
from csph.weights.shipped import checkpoint_name, shipped_file
from csph.weights.torch_files import load_torch_file
from scene2spad.methods import is_codes_file
from scene2spad.networks.registry import ModelSpec
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import save
from scenes.errors import InputError, require
from scenes.io.inputs import regular_file
from scenes.progress import Progress

CURVES = 4
# Figure 1 is at a compression of 128, Figure 17 at 64. Learned tensors are those of shipped models where there is one.
PAPER = (
    ("fourier", (1024, 1, 1)),
    ("gray", (1024, 1, 1)),
    ("learned", (1024, 1, 1)),
    ("learned", (256, 4, 4)),
    ("learned", (1024, 4, 4)),
)
RATIOS = {"tensors-128x": 128, "tensors-64x": 64}


def run(command: Study, progress: Progress) -> dict:
    """Draw the checkpoints, or the design asked for, or else the paper's designs at compressions of 128 and 64."""
    sheets: dict[str, list[CodingTensor]] = {}
    if command.checkpoints:
        sheets["tensors-checkpoints"] = [coding_of(path) for path in command.checkpoints]
    if command.design:
        design = Design.named(command.design, command.block, codes=command.codes, full=command.full)
        sheets["tensors-design"] = [_start(design, command.seed)]
    if not sheets:
        for name, ratio in RATIOS.items():
            sheets[name] = [_shipped_or_start(code, block, ratio, command.seed) for code, block in PAPER]
    command.out.mkdir(parents=True, exist_ok=True)
    drawn = []
    for number, (name, codings) in enumerate(sheets.items()):
        progress(name, number / len(sheets))
        drawn.append(str(draw(codings, command.out / f"{name}.png")))
    common = {name: [described(coding) for coding in codings] for name, codings in sheets.items()}
    return {"figures": drawn, "tensors": common}


def _shipped_or_start(code: str, block: tuple[int, int, int], ratio: int, seed: int) -> CodingTensor:
    """Return the codes of the shipped model of a learned design, of its first seed; else the design at its start."""
    design, model = Design.named(code, block, compression=ratio), ModelSpec(code, block, ratio).name
    start = _start(design, seed)  # also where it is not drawn: a seed out of range is refused
    return coding_of(Path(model)) if design.learned and shipped_file(model).is_file() else start


def _start(design: Design, seed: int) -> CodingTensor:
    coding = make_coding(design, seed=seed)
    if not design.learned:
        return coding
    untrained = "random start" if "temporal" in design.learned else "spatial part at its random start"
    return CodingTensor(f"{coding.name}, {untrained}", coding.temporal, coding.spatial, computed=coding.computed)


def coding_of(path: Path) -> CodingTensor:
    """Return the coding tensor of a model or a file. Raises InputError in one line.

    A model is a name (`models`), a run's folder or its checkpoint (.safetensors), and lends its name; a file of another
    program is a checkpoint whose state holds `temporal` and maybe `spatial` (of one layer, under any prefix), or a .npy
    array (K, Mt) or (K, Mt, Mr, Mc); tables of codes (.txt) are those of `export`.
    """
    path = checkpoint_of(path)
    if path.is_dir() or path.suffix == ".safetensors":
        return replace(model_coding(path), name=checkpoint_name(path))
    regular_file(path)
    if is_codes_file(path):
        return read_codes(path)
    state = load_torch_file(path)
    state = state.get("state_dict", state) if isinstance(state, dict) else {}
    found = [name for name in state if name.split(".")[-1] == "temporal" and isinstance(state[name], Tensor)]
    require(len(found) == 1, f"{path}: holds {len(found)} coding tensors (entries named temporal), expected one")
    beside = found[0].removesuffix("temporal") + "spatial"
    for name in (found[0], beside):
        part = state.get(name)
        good = part is None or (isinstance(part, Tensor) and part.is_floating_point() and bool(part.isfinite().all()))
        require(good, f"{path}: {name} is no tensor of finite numbers")
    try:
        return CodingTensor(path.stem, state[found[0]], state.get(beside))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def temporal_matrix(coding: CodingTensor) -> Tensor:
    """Return (K, Mt): the temporal part; of a full tensor that of the block's first pixel."""
    return coding.temporal if coding.temporal.ndim == 2 else coding.temporal[:, :, 0, 0]


def row_scaled(matrix: Tensor) -> Tensor:
    """Return every row stretched to -1 .. 1 between its least and largest value, as in the paper's figures; flat rows
    0."""
    low, high = matrix.amin(1, keepdim=True), matrix.amax(1, keepdim=True)
    return torch.where(high > low, (2 * matrix - low - high) / (high - low).clamp(min=1e-30), 0.0)


def described(coding: CodingTensor) -> dict[str, object]:
    """Return size and cost, the share of the codes' energy in the later half of Mt (S.1: near nothing where training
    scenes had no such depths), and each row's strongest harmonic."""
    matrix = temporal_matrix(coding).double()
    centred = matrix - matrix.mean(1, keepdim=True)
    energy = centred.square().sum(0)
    spectrum = torch.fft.rfft(matrix)[:, 1:].abs()
    return {
        "name": coding.name,
        "codes": coding.codes,
        "block": list(coding.block),
        "compression": coding.compression_ratio,
        "parameters": coding.parameters,
        "storage": coding.storage,
        "later_half_energy": float(energy[len(energy) // 2 :].sum() / energy.sum().clamp(min=1e-30)),
        "harmonics": (spectrum.argmax(1) + 1).tolist() if spectrum.shape[1] else [],
    }


def draw(codings: list[CodingTensor], path: Path) -> Path:
    """Draw one column a tensor: its matrix, rows scaled to +-1, and some of its rows as functions of time."""
    figure = plt.figure(figsize=(max(6.5, 4.2 * len(codings)), 7), layout="constrained")
    parts = figure.subfigures(1, len(codings), squeeze=False)[0]
    for part, coding in zip(parts, codings, strict=True):
        _column(part, coding, with_scale=coding is codings[-1])
    figure.suptitle("Temporal part of coding tensors")
    return save(figure, path)


def _column(part: SubFigure, coding: CodingTensor, with_scale: bool) -> None:
    matrix = temporal_matrix(coding)
    scaled = row_scaled(matrix).numpy()
    above, below = part.subplots(2, 1, height_ratios=(1.4, 1))
    shown = above.imshow(scaled, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto", interpolation="nearest")
    block = " x ".join(map(str, coding.block))
    pixel = ", first pixel" if coding.is_full and coding.rows * coding.columns > 1 else ""
    name = coding.name.split(" ")[0].rstrip(",")
    note = coding.name.partition(", ")[2]
    above.set_title(f"{name}{pixel}\n{block}, K = {coding.codes}{f' ({note})' if note else ''}", fontsize=9)
    above.set(xlabel="time bin of the block", ylabel="code k")
    if with_scale:
        part.colorbar(shown, ax=above, pad=0.02).set_label("every row scaled to ±1", fontsize=8)
    rows = np.unique(np.linspace(0, coding.codes - 1, min(CURVES, coding.codes)).astype(int))
    for place, row in enumerate(rows):  # one above the other: rows of noise would hide each other
        below.plot(scaled[row] - 2.5 * place, lw=0.7)
    below.set(xlabel="time bin of the block", yticks=-2.5 * np.arange(len(rows)))
    below.set_yticklabels([f"k = {row}" for row in rows])
    below.set_ylabel("rows, scaled to ±1 each")
