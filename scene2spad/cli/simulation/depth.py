"""Estimate depth from a histogram, or from a transient that is sensed first, and compare it with the truth."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import numpy as np

from scene2spad.cli.opening import open_for_depth, open_transient, pixel_sensor
from scene2spad.cli.paths import beside_folder, holds_kind, input_file, output_file, picture
from scene2spad.methods import codes_method, depth_method, is_codes_file
from scene2spad.options.common import Common, Count, File, GivenFile, Number, Positional, may_stay_open, only_for
from scenes.errors import InputError, require
from scenes.progress import Progress
from spad.formats.depth_map import write_depth

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from csph.networks.model import DepthModel
    from scene2spad.methods import Method
    from spad.measurements.histogram import Histogram
    from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")
SENSING = ("sensor", "signal", "background")  # options of a transient alone
Code = Literal["fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published"]
MEANS = ("mae_mm", "rmse_mm", "within_10mm")  # over the views of a folder
COUNTS = ("pixels", "empty", "beyond_range", "missing")
MAX_CODES = 9999  # by a method's name, fourier-9999


@dataclass(frozen=True, kw_only=True)
class Depth(Common):
    """Estimate depth from a histogram and compare it with the truth; writes the depth map and a picture. A transient is
    sensed first, as `sense` does; of a folder, every one."""

    file: Positional[GivenFile]
    """A histogram written by `sense` (.h5), its counts as `export` wrote them (.npz, .h5), a frame or capture of the
    published family (.mat), a transient (.exr), or the folder of a set or of transients."""
    out: File = None
    """The depth map (.exr) to write (default: the file's and the method's name, with "sensed" between them for a
    transient); of a folder, the folder for them."""
    method: Literal[
        "argmax", "matched", "log-matched", "correlation", "lmf-published", "coates", "compressive", "network"
    ] = "log-matched"
    """Estimator; log-matched is the Poisson maximum likelihood, coates the same after the pile-up is undone."""
    checkpoint: File = None
    """A checkpoint of `train`, or its folder, for `--method network`."""
    model: Annotated[str | None, may_stay_open("NAME")] = None
    """A model that comes with the package (see `models`), instead of --checkpoint."""
    decoder: Annotated[Literal["soft-argmax", "median"] | None, may_stay_open("{soft-argmax,median}")] = None
    """Depth that `--method network` reads from the posterior: its mean, or its median (default: the model's). The mean
    of periodic networks fails near both ends of the range."""
    int8: bool = False
    """Codes of `--method network` in 8 bits, summed in 16."""
    int8_rule: Annotated[Literal["calibrated", "published"] | None, may_stay_open("{calibrated,published}")] = None
    """Rounding of weights with --int8: 255 steps over each factor's own range (default), or over -1 to 1 as
    published."""
    code: Annotated[Code | None, may_stay_open(f"{{{','.join(get_args(Code))}}}")] = None
    """Temporal code of `--method compressive`: truncated Fourier, Gray Fourier, coarse histogram, Walsh-Hadamard; or
    the first two in their published rows (default: fourier)."""
    codes: Count = None
    """Number K of codes kept per pixel by `--method compressive` (default: 16)."""
    codes_file: File = None
    """Codes of your own for `--method compressive`, (K, T) in a file (.npy, or .txt as `export` writes it), instead of
    --code and --codes."""
    frame: int = 0
    """Frame of a capture (.mat) of several, from 0."""
    sensor: Annotated[str | None, may_stay_open("NAME")] = None
    """Sensor preset or file (.toml) that a transient is sensed with (default: reference)."""
    signal: Number = None
    """Mean signal photons per pixel that a transient is sensed with (default: 50)."""
    background: Number = None
    """Mean background photons per pixel that a transient is sensed with (default: 50, or the sensor's dark counts
    if they are more)."""
    figure: bool = True
    """Draw estimate, truth and error beside the file."""


def run(command: Depth, progress: Progress) -> dict:
    """Run the command: one file or a folder of transients -> depth maps, error figures and pictures."""
    _check_codes(command)
    _check_model(command)
    label = depth_label(command)
    if command.file.is_dir():
        result = _run_folder(command, label, progress)
        return result if command.json else readable(result)
    source = input_file(command.file)
    if source.suffix.lower() == ".safetensors":
        raise InputError(f"{source}: is a checkpoint, expected a histogram; give it as --method network --checkpoint")
    is_transient = source.suffix.lower() == ".exr" and holds_kind(source, "transient")
    # not the name of the map of `FILE.h5`, which other photons are in
    stem = f"{source.stem}-sensed" if is_transient else source.stem
    out = command.out or source.with_name(f"{stem}-{label}.exr")
    output_file(out, ".exr", "depth", figure=command.figure)
    network = _network(command)
    if is_transient:
        histogram, sensed = _sensed(command, source, command.seed)
        log.info("%s: sensed %s", source, sensed)
    else:
        asked = [name for name in SENSING if getattr(command, name) is not None]
        go = "goes" if len(asked) == 1 else "go"
        message = f"{source}: --{', --'.join(asked)} {go} with a transient (.exr), a histogram has been sensed"
        require(not asked, message)
        histogram, sensed = open_for_depth(source, command.frame), ""
    progress(command.method, 0.1)
    _warn_of_clock(command, network, histogram)
    result = _estimated(command, network, partial(_chosen_method, command), histogram, source, out)
    result = ({"sensed": sensed} if sensed else {}) | result
    return result if command.json else readable(result)


def readable(result: dict) -> dict:
    """Return a result for the terminal: where there is no error, why stands in the place of its figures."""
    from spad.estimators.depth import no_error_reason

    why = no_error_reason(result)
    kept = dict(result)
    if why is not None:
        unknown = (*MEANS, "median_mm", "median_abs_mm", "unmixed")
        items = (("errors", why) if key == "mae_mm" else (key, value) for key, value in result.items())
        kept = {key: value for key, value in items if key not in unknown}
    if isinstance(kept.get("unmixed"), dict):
        kept["unmixed"] = readable(kept["unmixed"])
    if "by_view" in kept:
        kept["by_view"] = [readable(view) for view in kept["by_view"]]
    return kept


def _sensed(command: Depth, source: Path, seed: int) -> tuple[Histogram, str]:
    """Return the histogram of a transient, and the words that say what it was sensed with."""
    from scene2spad.cli.simulation.sensing import DEFAULT_PHOTONS
    from spad.detection.detect import sense
    from spad.detection.rates import default_background
    from spad.sensor.model import PhotonBudget

    only_for(command, str(source), {"frame": (False, "captures (.mat)")})
    sensor = pixel_sensor(command.sensor, source)
    transient = open_transient(source, "transient", 0)
    signal, background = command.signal, command.background
    signal = DEFAULT_PHOTONS if signal is None else signal
    background = default_background(transient, sensor, seed=seed) if background is None else background
    histogram = sense(transient, sensor, PhotonBudget(signal, background), seed=seed)
    default = ", the defaults" if command.signal is None and command.background is None else ""
    return histogram, (
        f"by {sensor.name} with {signal:g} signal and {background:g} background photons a pixel{default}, seed {seed}"
    )


def _run_folder(command: Depth, label: str, progress: Progress) -> dict:
    """Run the command on every transient of a folder, each sensed by a seed of its own."""
    from scene2spad.datasets.renders import transient_files

    folder = command.file
    files = transient_files(folder)
    out = command.out or beside_folder(folder, f"-{label}")
    require(out.resolve().parent.is_dir(), f"{out}: folder {out.parent} does not exist")
    require(not out.is_file(), f"{out}: is a file, expected a folder for the depth maps")
    require(out.resolve() != folder.resolve(), f"{out}: is the folder of the transients")
    network = _network(command)
    targets = [out / f"{file.stem}-{label}.exr" for file in files]
    views, sensed = [], ""
    choose = cache(partial(_chosen_method, command))  # a file of codes is read, and warned of, once
    for number, (file, target) in enumerate(zip(files, targets, strict=True)):
        progress(file.name, number / len(files))
        histogram, words = _sensed(command, input_file(file), command.seed + number)
        sensed = sensed or f"{words} and more, one for each"
        if number == 0:
            _warn_of_clock(command, network, histogram)
        out.mkdir(exist_ok=True)
        output_file(target, ".exr", "depth", figure=command.figure)
        found = _estimated(command, network, choose, histogram, file, target)
        views.append({"file": str(file), **{key: found[key] for key in (*MEANS, *COUNTS, "out")}})
    log.info("%s: %d transients sensed %s", folder, len(files), sensed)
    means = {key: _mean([view[key] for view in views]) for key in MEANS}
    counts = {key: sum(view[key] for view in views) for key in COUNTS}
    common = {"sensed": sensed, "views": len(views), "method": label}
    return {**common, **means, **counts, "by_view": views, "out": str(out)}


def _mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean over the views or pixels that have a value, NaN of none."""
    known = np.asarray(values)[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _estimated(
    command: Depth,
    network: DepthModel | None,
    choose: Callable[[Sensor], Method],
    histogram: Histogram,
    source: Path,
    out: Path,
) -> dict:
    """Estimate depth from a histogram; write the map and its picture, and return errors and files."""
    from spad.estimators.bistatic import pointing_of
    from spad.estimators.depth import confidence_map, histogram_errors

    label = depth_label(command)
    start = time.perf_counter()
    reading: dict[str, object] = {}
    if network is None:
        depth = choose(histogram.sensor)(histogram)
        seconds = time.perf_counter() - start
        # depths of codes are judged by all bins, as those of any method but one are
        sure = confidence_map(histogram, depth, "coates" if command.method == "coates" else "log-matched")
    else:
        rule = command.int8_rule or "calibrated"
        reading["decoder"] = command.decoder or network.config.decoder
        reading |= {"int8_rule": rule} if command.int8 else {}
        depth, sure, overflows = network.estimate(histogram, int8=command.int8, int8_rule=rule, decoder=command.decoder)
        if overflows:
            log.warning("%d sums of 16 bits wrapped around", overflows)
        seconds = time.perf_counter() - start
    errors = histogram_errors(depth, histogram)
    if np.isnan(histogram.depth_m).all():
        log.info("%s: holds no true depth, so that no error can be stated", source)
    unmixed = {}
    if source.suffix.lower() != ".mat":  # of whose pixels nobody knows which are mixed
        unmixed["unmixed"] = histogram_errors(depth, histogram, exclude=histogram.mixed)
    meta = {"method": label, "histogram_sha256": histogram.sha256(), **reading}
    write_depth(depth, out, meta | pointing_of(histogram.meta), sure)
    result = {
        "seconds": seconds,
        "method": label,
        **errors,
        "confidence": _mean([] if sure is None else sure),
        **unmixed,
        "out": str(out),
    }
    if command.figure:
        from scene2spad.plots import figures

        result["figure"] = str(figures.draw_depth(histogram, depth, label, errors, picture(out, "depth")))
    return result


def depth_label(command: Depth) -> str:
    """Name a depth map after its method, so that results of two checkpoints, or of two readings of one, do not
    overwrite one another."""
    if command.method == "compressive" and command.codes_file is not None:
        return command.codes_file.stem
    if command.method == "compressive":
        return _code_name(command)
    if command.method == "network" and command.model is not None:
        return f"network-{command.model}{_reading(command)}"
    if command.method != "network" or command.checkpoint is None:
        return command.method
    from csph.weights.shipped import RUN_WEIGHTS

    checkpoint = command.checkpoint
    if checkpoint.is_dir():
        return f"network-{checkpoint.resolve().name}{_reading(command)}"
    run = f"{checkpoint.resolve().parent.name}-" if checkpoint.stem in RUN_WEIGHTS else ""
    return f"network-{run}{checkpoint.stem}{_reading(command)}"


def _reading(command: Depth) -> str:
    """Return how a network is read, as its label ends: the decoder that is asked for, and codes in 8 bits."""
    decoder = "" if command.decoder is None else f"-{command.decoder}"
    published = "-published" if command.int8_rule == "published" else ""
    return f"{decoder}-int8{published}" if command.int8 else decoder


def _code_name(command: Depth) -> str:
    """Return the code of `--method compressive` by its name, as in fourier-16."""
    return f"{command.code or 'fourier'}-{16 if command.codes is None else command.codes}"


def _check_codes(command: Depth) -> None:
    """Raise InputError for options of codes that the method, or a file of codes, leaves without a meaning."""
    compressive, own = command.method == "compressive", command.codes_file is not None
    purpose = "--method compressive"
    known = command.codes_file is None or is_codes_file(command.codes_file)
    require(known, f"--codes-file {command.codes_file}: expected codes (K, T) in a .npy file, or a .txt of `export`")
    only_for(command, "depth", dict.fromkeys(("code", "codes", "codes_file"), (compressive, purpose)))
    only_for(command, "depth", dict.fromkeys(("code", "codes"), (not own, f"{purpose} without --codes-file")))
    good = command.codes is None or 1 <= command.codes <= MAX_CODES
    require(good, f"depth: --codes {command.codes} is outside 1 to {MAX_CODES}")


def _check_model(command: Depth) -> None:
    """Raise InputError for a path as --model, which names results, and is a name that comes with the package."""
    model = command.model
    if model is None:
        return
    hint = "expected a name that `models` lists; a run's folder or a checkpoint goes with --checkpoint"
    require(Path(model).name == model, f"--model {model!r}: {hint}")
    from csph.weights.shipped import shipped_file

    shipped = shipped_file(model).is_file()
    require(shipped or not Path(model).exists(), f"--model {model!r}: {hint}")


def _chosen_method(command: Depth, sensor: Sensor) -> Method:
    """Return the method without a network that the options name."""
    if command.codes_file is not None:
        return codes_method(input_file(command.codes_file), sensor)
    name = _code_name(command) if command.method == "compressive" else command.method
    return depth_method(name, sensor, seed=command.seed)


def _warn_of_clock(command: Depth, network: DepthModel | None, histogram: Histogram) -> None:
    if network is not None:
        from scene2spad.networks.end_warnings import warn_of_clock

        warn_of_clock(command.model or str(command.checkpoint), network.config, histogram.sensor)


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
    from csph.networks.checkpoint import load_model
    from csph.weights.cards import shipped_model
    from scene2spad.networks.end_warnings import warn_of_ends, warn_of_unfinished

    checkpoint = command.checkpoint if command.model is None else shipped_model(command.model)
    assert checkpoint is not None
    model = load_model(checkpoint)[0]
    warn_of_unfinished(checkpoint)
    warn_of_ends(command.model or str(checkpoint), model.config, command.decoder)
    return model
