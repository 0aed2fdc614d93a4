"""`bench encode`: seconds against error of the compressive layer, as matrix products and as strided convolutions, and
of encoding photon timestamps with and without building a histogram. Same tensors, same photons, interleaved runs."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv3d, conv_transpose3d

from csph import CompressiveLayer, Design
from csph.codes.blocks import EPSILON
from csph.codes.photons import encode_photons, photon_table
from scene2spad.options.experiments import Bench
from scenes.errors import require
from scenes.files import whole_file, write_csv
from scenes.io.versions import installed_versions
from scenes.progress import Progress
from spad.measurements.histogram import counts_from_timestamps

BATCH, SIZE, PHOTONS = 4, (1024, 32, 32), 60
DESIGNS = (
    Design("learned", (1024, 4, 4), 128, full=True),
    Design("learned", (256, 4, 4), 32, full=True),
    Design("learned", (1024, 1, 1), 8),
    Design("learned", (1024, 4, 4), 128),
    Design("learned", (256, 4, 4), 32),
)
ROUNDS = 3  # times --repeats
SIGNAL_SIGMA_BINS = 1.4


@dataclass(frozen=True)
class Row:
    """One method on one design.

    part     layer: encode and decode, forward and backward; encode: codes from timestamps
    error    largest deviation from float64, relative to the largest value: of the output and the weights' gradients
             (layer), of the codes (encode)
    speedup  of this method over the slowest of its part and design
    """

    name: str
    part: str
    design: str
    seconds: float
    least_seconds: float
    error: float
    runs: int
    speedup: float = 1.0


def run(command: Bench, progress: Progress) -> dict:
    """Measure, write the table (.csv, .json) and the picture, and return rows and what they mean for each design."""
    require(not command.out.is_file(), f"{command.out}: is a file, expected a folder for the results")
    rng = np.random.default_rng(np.random.SeedSequence(command.seed))
    stamps, offsets = photons(rng, BATCH, SIZE)
    counts = dense(stamps, offsets, SIZE)
    rounds = ROUNDS * command.repeats
    rows: list[Row] = []
    for number, design in enumerate(DESIGNS):
        progress(f"layer {design.name}", number / len(DESIGNS))
        rows += measure_layer(design, counts, rounds, command.seed)
        progress(f"encode {design.name}", (number + 0.5) / len(DESIGNS))
        rows += measure_encoding(design, stamps, offsets, rounds, command.seed)
    command.out.mkdir(parents=True, exist_ok=True)
    result = {"rows": [asdict(row) for row in rows], **_write(rows, command.out)}
    if not command.json:
        result["rows"] = [_line(row) for row in rows]
    return result


def photons(rng: np.random.Generator, batch: int, size: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Return detections of a batch of patches, Poisson with mean PHOTONS a pixel, half of them in a pulse: uint16,
    int64."""
    pixels, bins = batch * size[1] * size[2], size[0]
    numbers = rng.poisson(PHOTONS, pixels)
    pixel = np.repeat(np.arange(pixels), numbers)
    pulse = rng.normal(rng.uniform(0.1 * bins, 0.9 * bins, pixels)[pixel], SIGNAL_SIGMA_BINS).clip(0, bins - 1)
    stamps = np.where(rng.random(len(pixel)) < 0.5, pulse.astype(np.int64), rng.integers(0, bins, len(pixel)))
    stamps = stamps[np.lexsort((stamps, pixel))].astype(np.uint16)
    return torch.from_numpy(stamps), torch.from_numpy(np.concatenate(([0], np.cumsum(numbers))))


def dense(stamps: Tensor, offsets: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Return (B, 1, T, R, C) float32 counts, each detection scattered into its place: the quickest way found."""
    bins, pixels = size[0], size[1] * size[2]
    images = (len(offsets) - 1) // pixels
    pixel = torch.arange(images * pixels)
    first = (pixel // pixels) * (bins * pixels) + pixel % pixels
    index = torch.repeat_interleave(first, offsets.diff(), output_size=len(stamps)) + stamps.long() * pixels
    counts = torch.zeros(images * bins * pixels)
    counts.scatter_add_(0, index, torch.ones(len(index)))
    return counts.view(images, 1, *size)


def dense_of_sensor(stamps: Tensor, offsets: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Return the same by `spad.measurements`, as a histogram file is read: integer counts pixel by pixel, then time
    first."""
    counts = counts_from_timestamps(stamps.numpy(), offsets.numpy(), size[0])
    return torch.from_numpy(counts).view(-1, 1, *size[1:], size[0]).permute(0, 1, 4, 2, 3).float().contiguous()


def convolved(layer: CompressiveLayer, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return codes and back-projection as published: strided convolutions of the constrained weights, transposed ones
    back."""

    def normalised(values: Tensor, axis: int) -> Tensor:
        values = values - values.mean(axis, keepdim=True)
        return values / (values.norm(dim=axis, keepdim=True) + EPSILON)

    temporal = layer.temporal if layer.temporal.ndim == 4 else layer.temporal[..., None, None]
    temporal = (temporal - temporal.mean(1, keepdim=True)).unsqueeze(1)
    codes, weights = conv3d(counts, temporal, stride=temporal.shape[2:]), temporal
    if layer.spatial is not None:
        spatial = layer.spatial[:, None, None]
        codes = conv3d(codes, spatial, stride=spatial.shape[2:], groups=len(spatial))
        weights = temporal * spatial
    return codes, conv_transpose3d(normalised(codes, 1), normalised(weights, 0), stride=weights.shape[2:])


Form: TypeAlias = Callable[[CompressiveLayer, Tensor], Tensor]


def measure_layer(design: Design, counts: Tensor, rounds: int, seed: int) -> list[Row]:
    """Encode and decode, forward and backward with respect to the weights."""
    layer = CompressiveLayer.of(design, seed=seed)
    gradient = torch.randn(counts.shape, generator=torch.Generator().manual_seed(seed))
    forms: dict[str, Form] = {
        "strided convolutions": lambda layer, counts: convolved(layer, counts)[1],
        "matrix products": lambda layer, counts: layer(counts),
    }

    def once(form: Form, layer: CompressiveLayer, counts: Tensor) -> list[Tensor]:
        layer.zero_grad(set_to_none=True)
        output = form(layer, counts)
        output.backward(gradient.to(output.dtype))
        return [output.detach(), *(part.grad for part in layer.parameters() if part.grad is not None)]

    exact = once(forms["strided convolutions"], CompressiveLayer.of(design, seed=seed).double(), counts.double())
    calls = {name: partial(once, form, layer, counts) for name, form in forms.items()}
    return _measured(calls, "layer", design, exact, rounds)


def measure_encoding(design: Design, stamps: Tensor, offsets: Tensor, rounds: int, seed: int) -> list[Row]:
    """Return codes from timestamps with fixed weights, as a sensor has them: both routes may prepare the weights
    before."""
    with torch.no_grad():
        layer = CompressiveLayer.of(design, seed=seed)
        weights = layer.weights()
        fixed = CompressiveLayer(layer.coding(), options=type(layer.options)(zero_mean=False))
        table = photon_table(weights)
        kernel = weights.unsqueeze(1)
        forms: dict[str, Callable[[], Tensor]] = {
            "histogram of spad, matrix product": lambda: fixed.encode(dense_of_sensor(stamps, offsets, SIZE)),
            "histogram, strided convolution": lambda: conv3d(
                dense(stamps, offsets, SIZE), kernel, stride=kernel.shape[2:]
            ),
            "histogram, matrix product": lambda: fixed.encode(dense(stamps, offsets, SIZE)),
            "timestamps": lambda: encode_photons(stamps, offsets, table, design.block, SIZE),
        }
        exact = fixed.double().encode(dense(stamps, offsets, SIZE))
        fixed.float()
        calls = {name: partial(_as_list, form) for name, form in forms.items()}
        return _measured(calls, "encode", design, [exact], rounds)


def _as_list(form: Callable[[], Tensor]) -> list[Tensor]:
    return [form()]


def _measured(
    calls: Mapping[str, Callable[[], list[Tensor]]], part: str, design: Design, exact: list[Tensor], rounds: int
) -> list[Row]:
    """Measure median and least seconds of each call, taken in turn so that a busy machine is busy for all of them."""
    errors: dict[str, float] = {}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for name, call in calls.items():  # the first run warms up, and is the one that is judged
        errors[name] = max(_deviation(*pair) for pair in zip(call(), exact, strict=True))
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    median = {name: statistics.median(times) for name, times in seconds.items()}
    slowest = max(median.values())
    return [
        Row(name, part, design.name, median[name], min(times), errors[name], rounds, slowest / median[name])
        for name, times in seconds.items()
    ]


def _deviation(value: Tensor, exact: Tensor) -> float:
    return float((value.double() - exact).abs().max() / exact.abs().max())


def _line(row: Row) -> str:
    message = f"{row.part:<7} {row.design:<26} {row.name:<32} {1000 * row.seconds:>8.2f} ms"
    return f"{message} (least {1000 * row.least_seconds:.2f})  error {row.error:.1e}  {row.speedup:.1f}x"


def _write(rows: list[Row], folder: Path) -> dict[str, str]:
    machine = {
        "processor": platform.processor() or platform.machine(),
        "cpus": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "versions": installed_versions("scene2spad", "torch"),
    }
    names = {key: str(folder / f"bench-encode.{ending}") for key, ending in (("csv", "csv"), ("results", "json"))}
    write_csv([asdict(row) for row in rows], Path(names["csv"]))
    with whole_file(Path(names["results"])) as beside:
        beside.write_text(json.dumps({"rows": [asdict(row) for row in rows], "machine": machine}, indent=1) + "\n")
    return {**names, "figure": str(_draw(rows, folder / "bench-encode.png"))}


def _draw(rows: list[Row], path: Path) -> Path:
    """Error against seconds, one panel a part, one mark a design, one colour a method."""
    from matplotlib import pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter

    from scene2spad.plots.figures import save

    figure, panels = plt.subplots(1, 2, figsize=(12, 5.6), layout="constrained")
    marks = dict(zip((design.name for design in DESIGNS), "os^DvP*X", strict=False))
    titles = {
        "layer": "encode and decode, forward and backward",
        "encode": f"encoding alone, {PHOTONS} photons a pixel",
    }
    for axes, (part, title) in zip(panels, titles.items(), strict=True):
        mine = [row for row in rows if row.part == part]
        colours = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(row.name for row in mine))}
        for row in mine:
            axes.plot(row.seconds, row.error, marks[row.design], color=colours[row.name], ms=8)
        axes.set(xscale="log", yscale="log", title=title, xlabel="seconds, median",
                 ylabel="largest deviation from float64, relative")  # fmt: skip
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_formatter(NullFormatter())
        axes.margins(0.15)
        axes.grid(alpha=0.3, which="both")
        handles = [Line2D([], [], color=colour, marker="s", ls="", label=name) for name, colour in colours.items()]
        axes.legend(handles=handles, fontsize=8, loc="best")
    designs = [Line2D([], [], color="0.4", marker=mark, ls="", label=name) for name, mark in marks.items()]
    figure.legend(handles=designs, loc="outside lower center", ncols=3, fontsize=8)
    shape = f"{BATCH} patches of {SIZE[1]} x {SIZE[2]} x {SIZE[0]}"
    figure.suptitle(f"Speed against error, {shape}, {torch.get_num_threads()} threads: lower left is better")
    return save(figure, path)
