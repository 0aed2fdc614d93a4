"""Estimate depth from a histogram, and compare it with the truth."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from scene2spad.cli.opening import open_histogram
from scene2spad.cli.paths import holds_kind, input_file, output_file, picture
from scene2spad.methods import depth_method
from scene2spad.options.common import Common, File, Positional, may_stay_open
from scenes.errors import InputError, require
from scenes.progress import Progress
from spad.formats.depth_map import write_depth

if TYPE_CHECKING:
    from collections.abc import Callable

    from csph.networks.model import DepthModel
    from spad.formats.histogram import Histogram
    from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")


@dataclass(frozen=True, kw_only=True)
class Depth(Common):
    """Estimate depth from a histogram and compare it with the truth; writes the depth map and a picture."""

    file: Positional[Path]
    """A histogram written by `sense` (.h5), or a frame or capture of the published family (.mat)."""
    out: File = None
    """The depth map (.exr) to write (default: the histogram's and the method's name)."""
    method: Literal[
        "argmax", "matched", "log-matched", "correlation", "lmf-published", "coates", "compressive", "network"
    ] = "log-matched"
    """Estimator; log-matched is the Poisson maximum likelihood, coates the same after the pile-up is undone."""
    checkpoint: File = None
    """A checkpoint of `train`, or its folder, for `--method network`."""
    model: Annotated[str | None, may_stay_open("NAME")] = None
    """A model that comes with the package (see `models`), instead of --checkpoint."""
    decoder: Annotated[Literal["soft-argmax", "median"] | None, may_stay_open("{soft-argmax,median}")] = None
    """Depth that `--method network` reads from the posterior: its mean, or its median (default: the model's)."""
    int8: bool = False
    """Codes of `--method network` in 8 bits, summed in 16."""
    int8_rule: Annotated[Literal["calibrated", "published"] | None, may_stay_open("{calibrated,published}")] = None
    """Rounding of weights with --int8: 255 steps over each factor's own range (default), or over -1 to 1 as
    published."""
    code: Literal["fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published"] = "fourier"
    """Temporal code of `--method compressive`: truncated Fourier, Gray Fourier, coarse histogram, Walsh-Hadamard; or
    the first two in their published rows."""
    codes: int = 16
    """Number K of codes kept per pixel by `--method compressive`."""
    codes_file: File = None
    """Codes of your own for `--method compressive`, (K, T) in a .npy file, instead of --code and --codes."""
    frame: int = 0
    """Frame of a capture (.mat) of several, from 0."""
    figure: bool = True
    """Draw estimate, truth and error beside the file."""


def run(command: Depth, progress: Progress) -> dict:
    """Run the command: histogram -> depth map, error figures and a picture."""
    from scene2spad.cli.sensing import mean_confidence
    from spad.estimators.depth import depth_errors

    label = depth_label(command)
    source = input_file(command.file)
    _expect_histogram(source)
    out = output_file(command.out or source.with_name(f"{source.stem}-{label}.exr"), ".exr", "depth")
    histogram = open_histogram(source, command.frame)
    progress(command.method, 0.1)
    network, fraction = _network(command), None
    start = time.perf_counter()
    if network is None:
        depth = _chosen_method(command, histogram.sensor)(histogram)
    else:
        rule = command.int8_rule or "calibrated"
        depth, fraction, overflows = network.estimate(
            histogram, int8=command.int8, int8_rule=rule, decoder=command.decoder
        )
        if overflows:
            log.warning("%d sums of 16 bits wrapped around", overflows)
    seconds = time.perf_counter() - start
    sure = mean_confidence(histogram, depth)
    range_m = histogram.sensor.range_m
    errors = depth_errors(depth, histogram.depth_m, range_m=range_m)
    if np.isnan(histogram.depth_m).all():
        log.info("%s: holds no true depth, so that no error can be stated", source)
    meta = {"method": label, "histogram_sha256": histogram.sha256()}
    camera = histogram.meta.get("transient", {}).get("camera")
    write_depth(depth, out, meta | ({"camera": camera} if camera else {}), fraction)
    result = {
        "seconds": seconds,
        "method": label,
        **errors,
        "confidence": sure,
        "unmixed": depth_errors(depth, histogram.depth_m, range_m=range_m, exclude=histogram.mixed),
        "out": str(out),
    }
    if fraction is not None:
        result["posterior_within_3_bins"] = float(fraction.mean())
    if command.figure:
        from scene2spad.plots import figures

        result["figure"] = str(figures.draw_depth(histogram, depth, label, errors, picture(out, "depth")))
    return result


def depth_label(command: Depth) -> str:
    """Name a depth map after its method, so that results of two checkpoints do not overwrite one another."""
    if command.method == "compressive" and command.codes_file is not None:
        return command.codes_file.stem
    if command.method == "compressive":
        return f"{command.code}-{command.codes}"
    if command.method == "network" and command.model is not None:
        return f"network-{command.model}"
    if command.method != "network" or command.checkpoint is None:
        return command.method
    from csph.weights.shipped import RUN_WEIGHTS

    checkpoint = command.checkpoint
    if checkpoint.is_dir():
        return f"network-{checkpoint.resolve().name}"
    run = f"{checkpoint.resolve().parent.name}-" if checkpoint.stem in RUN_WEIGHTS else ""
    return f"network-{run}{checkpoint.stem}"


def _expect_histogram(path: Path) -> None:
    """Refuse a file of another of our kinds by its name, with the command that takes it."""
    if path.suffix.lower() == ".exr" and holds_kind(path, "transient"):
        raise InputError(f"{path}: is a transient, expected a histogram; run `scene2spad sense {path}` first")
    if path.suffix.lower() == ".safetensors":
        raise InputError(f"{path}: is a checkpoint, expected a histogram; give it as --method network --checkpoint")


def depth_map(histogram: Histogram, method: str, codes: int = 16, code: str = "fourier", seed: int = 0) -> np.ndarray:
    """Estimate depth [m] by a method's name, (H, W) float32; `compressive` keeps K codes of a temporal code."""
    return depth_method(f"{code}-{codes}" if method == "compressive" else method, histogram.sensor, seed=seed)(
        histogram
    )


def _chosen_method(command: Depth, sensor: Sensor) -> Callable[[Histogram], np.ndarray]:
    """Return the method without a network that the options name."""
    compressive = command.method == "compressive"
    if command.codes_file is not None:
        require(compressive, "depth: --codes-file goes with --method compressive")
        return depth_method(str(input_file(command.codes_file)), sensor)
    name = f"{command.code}-{command.codes}" if compressive else command.method
    return depth_method(name, sensor, seed=command.seed)


def _network(command: Depth) -> DepthModel | None:
    wanted = command.method == "network"
    given = (command.checkpoint is not None) + (command.model is not None)
    if wanted != (given == 1) or (not wanted and (given or command.int8 or command.decoder)):
        raise InputError(
            "depth: --method network and --checkpoint or --model go together, and --int8, --decoder with them"
        )
    if command.int8_rule and not command.int8:
        raise InputError("depth: --int8-rule goes with --int8")
    if not wanted:
        return None
    from csph.networks.model import load_model
    from csph.weights.cards import shipped_model

    return load_model(command.checkpoint or shipped_model(command.model))[0]
