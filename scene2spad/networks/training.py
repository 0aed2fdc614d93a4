"""`train`: from the command line's words to csph's configuration and sets; depth by networks and by baselines."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from csph import CodingTensor, decode_depth, encode, temporal_code
from csph.codes.design import Design
from csph.codes.files import own_codes
from csph.evaluation.methods import DepthEstimator, Method
from csph.layer import SpatialStart
from csph.networks.checkpoint import load_model
from csph.networks.config import ON_CPU, Front, ModelConfig, Network, TrainConfig, preset
from csph.networks.model import DepthModel
from csph.training.beginning import NetworkOf, WeightsOf, check_init
from csph.training.lineage import begin_with
from csph.training.overlap import overlap, repeated
from csph.training.own_codes import FILE, codes_path
from csph.training.resume import require_free
from csph.training.views import Views, is_seen, read_views, split_views
from csph.weights.cards import checkpoint_of
from scene2spad.datasets.planes import random_planes
from scene2spad.datasets.workers import check_workers
from scene2spad.methods import code_of
from scene2spad.networks.end_warnings import warn_of_unfinished
from scene2spad.networks.level_warnings import level_warnings
from scene2spad.options.networks import PLANES, Train, check_used
from scenes.errors import InputError, require
from scenes.progress import Progress
from spad.estimators.depth import METHODS, estimate_depth, histogram_depth_m
from spad.measurements.histogram import Histogram
from spad.sensor.files import load_sensor
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")

PLANE_SCENES = {"smoke": 20, "laptop": 2000, "laptop-v1": 2000, "workstation": 4000, "gpu": 4000, "paper": 13851}
SMOKE_PIXELS = 32
DEFAULT_COMPRESSION = 128.0
_WEIGHTED = "; --set-weights says how often a set is drawn from"


def config_of(command: Train) -> TrainConfig:
    """Return the preset with what the command line changes. Raises InputError for options that do not fit together."""
    described = load_sensor(command.sensor)
    require(described.zones is None, f"train: sensor {command.sensor} has zones, networks are for pixels")
    sensor = described.sensor
    _check_numbers(command)
    design = _design_of(command)
    network = command.network or _default_network(command, design)
    # the published network finds the pulse in the counts by itself; ours, of few layers, is given them matched
    uncoded: dict[str, Front] = {"none": "matched" if network == "compact" else "counts", "peak": "peak"}
    front = "codes" if design is not None else uncoded[command.design]
    switches: tuple[str, ...] = command.layer
    layer = dict.fromkeys(switches, True)
    # the first models' and the published start, which their recipes reproduce
    start: SpatialStart = "uniform" if command.preset in ("paper", "laptop-v1") else "orthogonal"
    start = command.spatial_start or start
    start = start if design is not None and "spatial" in design.learned else "uniform"
    try:
        model = ModelConfig(front, design, layer, network, sensor, command.grid, start)
    except InputError as error:
        chosen = command.codes_file or (None if command.network else _begun_name(command))  # by which file or model
        raise InputError(f"{chosen}: {error}" if chosen else str(error)) from None
    config = preset(
        command.preset,
        model,
        seed=command.seed,
        batch=command.batch,
        crop=command.crop,
        optimiser=command.optimiser,
        rate=command.rate,
        tv_weight=command.tv,
        tv_start=command.tv_start,
        precision=command.precision,
        threads=command.threads,
        time_offset_m=command.time_offset,
        levels=command.levels,
        window=command.window,
        weights=command.set_weights or None,
        coherence=command.coherence,
        init_share=command.init_share,
        sense_on=command.sense_on,
        decoded_weight=command.decoded,
        data=None if command.codes_file is None else {FILE: str(command.codes_file)},
    )
    if command.steps is None:
        return config
    # as many epochs, each shorter, and the rate steps down at the same shares of the run
    require(command.steps >= 1, f"steps {command.steps} is below 1")
    epochs = min(config.epochs, command.steps)
    each = -(-command.steps // epochs)
    decay_steps = max(1, round(config.decay_steps * each / config.steps_per_epoch))
    warmup = min(config.warmup, command.steps // 10)
    return replace(config, epochs=epochs, steps_per_epoch=each, decay_steps=decay_steps, warmup=warmup)


def _design_of(command: Train) -> Design | None:
    """Return the codes that are asked for; None for designs without. Raises InputError for a file of own codes beside
    another block or number."""
    if command.codes_file is None:
        if command.design in ("none", "peak"):
            return None
        compression = _compression(command)
        return Design.named(
            command.design, command.block, codes=command.codes, compression=compression, full=command.full
        )
    design, coding = own_codes(codes_path(command.codes_file, folder_of(command)))
    alike = design.codes > 1 and bool((coding.tensor == coding.tensor[:1]).all())
    zeros = f"{command.codes_file}: all its codes are the same: their mean over K is removed, which leaves zeros"
    require(not alike or "keep_mean" in command.layer, f"{zeros}; --layer keep_mean keeps it")
    asked = {
        "--block": (command.block, (Train.block, design.block)),
        "--codes": (command.codes, (None, design.codes)),
        "--compression": (command.compression, (None, design.compression_ratio)),
    }
    holds = f"holds {design.codes} codes over blocks of {design.block_name}"
    for name, (value, fitting) in asked.items():
        words = " ".join(map(str, value)) if isinstance(value, tuple) else value
        require(value in fitting, f"train: {name} {words}: {command.codes_file} {holds}; leave {name} out")
    return design


def _begun_name(command: Train) -> str | None:
    return command.init or command.init_network


def _compression(command: Train) -> float | None:
    """Return the compression asked for, DEFAULT_COMPRESSION of none; None where the number of codes is given."""
    if command.codes is None:
        return DEFAULT_COMPRESSION if command.compression is None else command.compression
    require(command.compression is None, f"train: give --codes {command.codes} or --compression, not both")
    return None


def _check_numbers(command: Train) -> None:
    """Raise InputError for numbers of devices, threads and set weights that no training can have, and a share of no
    model, and what would be ignored."""
    check_used(command)
    for name, value in (("devices", command.devices), ("threads", command.threads)):
        require(value is None or value >= 1, f"train: --{name} {value} is below 1")
    more = f"train: --devices {command.devices}: a training is on one device; others are for other runs"
    require(command.devices in (None, 1), more)
    require(not command.init_share or command.init is not None, "train: --init-share needs --init")
    require(command.init is None or command.init_network is None, "train: give --init or --init-network, not both")
    weights, sets = len(command.set_weights), len(command.set)
    require(weights in (0, sets), f"train: {weights} --set-weights for {sets} sets, expected one for each")
    for option, paths in (("set", command.set), ("validation", command.validation)):
        places = [path.resolve() for path in paths]
        twice = next((path for path, place in zip(paths, places, strict=True) if places.count(place) > 1), None)
        cure = _WEIGHTED if option == "set" else ""
        require(twice is None, f"train: --{option} {twice} is given twice{cure}")


def _default_network(command: Train, design: Design | None) -> Network:
    """Return the network of the model to begin with; else of a preset: published with paper; refined for codes of
    several pixels, where training has the time for it; else compact."""
    begun = _begun_name(command)
    if begun is not None:
        return load_model(checkpoint_of(begun))[1].model.network
    if command.preset == "paper":
        return "published"
    coded = design is not None and math.prod(design.block[1:]) > 1 and design.block[0] % 16 == 0
    return "refined" if coded and command.preset in ON_CPU else "compact"


def views_of(command: Train, crop: int) -> tuple[list[Views], list[Views], dict[str, object]]:
    """Return training and validation views of every set, and the words that say which they are. Raises InputError for
    training views that hold no patch of `crop` pixels a side."""
    sets = [_views_of_set(path, command, crop) for path in command.set]
    check_once("set", command.set, sets)
    common = {"training": _paths(command.set), "validation": _paths(command.validation) or "its last scenes"}
    if command.validation:
        training, validation = sets, [_views_of_one_size(path) for path in command.validation]
        check_once("validation", command.validation, validation)
    else:
        parts = [_split(path, views) for path, views in zip(command.set, sets, strict=True)]
        training, validation = [first for first, _ in parts], [second for _, second in parts]
    check_apart(command, training, validation)
    return training, validation, {**common, "training_reach_m": max(map(training_reach_m, training), default=0.0)}


def check_once(option: str, paths: Sequence[Path], sets: Sequence[Views]) -> None:
    """Raise InputError for two sets of the same views, as a folder and its pack."""
    twice = repeated(sets)
    if twice is not None:
        first, second = (paths[number] for number in twice)
        cure = _WEIGHTED if option == "set" else ""
        raise InputError(f"train: --{option} {first} and {second} hold the same views{cure}")


def check_apart(command: Train, training: Sequence[Views], validation: Sequence[Views]) -> None:
    """Raise InputError where a validation set holds nothing but training views. Warn of validation views that are
    trained on, and of those whose scenes are: also of sets that share scenes, each of which is split by itself."""
    found = overlap(training, validation)
    if found.same_views and command.validation:
        for path, views in zip(command.validation, validation, strict=True):
            one = overlap(training, [views])
            message = f"train: --validation {path}: all its {one.views} views are in --set, too, and are trained on"
            require(one.same_views < one.views, f"{message}; give views of other scenes")
    if found.same_scenes:
        cure = "give --validation views of other scenes"
        message = "%d of %d validation views are trained on, %d show scenes that are: validation errors are too low; %s"
        log.warning(message, found.same_views, found.views, found.same_scenes, cure)


def _split(path: Path, views: Views) -> tuple[Views, Views]:
    try:
        return split_views(views)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _views_of_set(path: Path, command: Train, crop: int) -> Views:
    if path == PLANES:
        _check_crop(path, _plane_pixels(command), crop)
        return random_planes(PLANE_SCENES[command.preset], size=_plane_pixels(command), seed=command.seed)
    views = _views_of_one_size(path)
    first = views.transients[0]
    _check_crop(path, min(first.height, first.width), crop)
    return views


def _plane_pixels(command: Train) -> int:
    return SMOKE_PIXELS if command.preset == "smoke" else 64


def _check_crop(path: Path, side: int, crop: int) -> None:
    message = f"train: --set {path}: crops of {crop} pixels do not fit views of {side}; give a smaller --crop"
    require(crop <= side, message)


def _views_of_one_size(path: Path) -> Views:
    """Read a rendered set; InputError for other files, and views of several sizes, of which no batch is made."""
    other = path.is_file() and path.suffix.lower() != ".h5"
    require(not other, f"{path}: expected the folder of a set that `dataset` rendered, or its pack (.h5)")
    views = read_views(path)
    sizes = sorted({(one.width, one.height) for one in views.transients})
    several = " and ".join(f"{width} x {height}" for width, height in sizes[:2])
    require(len(sizes) == 1, f"{path}: views are of several sizes ({several} pixels), training takes one size")
    return views


def check_sets(command: Train, crop: int) -> None:
    """Raise InputError where the run would: for a set that cannot be read or trained on, or not be validated on. Planes
    are not drawn for it."""
    if PLANES in command.set:
        _check_crop(PLANES, _plane_pixels(command), crop)
    views_of(replace(command, set=tuple(path for path in command.set if path != PLANES)), crop)


def _paths(paths: Sequence[Path]) -> str | list[str]:
    """Return a set's path as it was given; a list of several."""
    lines = [str(path) for path in paths]
    return lines if len(lines) > 1 else "".join(lines)


def training_reach_m(views: Views) -> float:
    """Return the depth that 99.9 % of the views' pixels do not pass [m]."""
    depth = np.concatenate([t.depth_m[np.isfinite(t.depth_m)] for t in views.transients] or [np.zeros(0)])
    return round(float(np.quantile(depth, 0.999)), 3) if depth.size else 0.0


def run_train(command: Train, progress: Progress) -> dict:
    """Train one model, or go on with an interrupted run in the same folder."""
    config = config_of(command)
    config.check_memory()
    require(bool(command.set), "train: --set without a set")
    check_workers(command.workers, least=0)
    folder = folder_of(command)
    require_free(folder)
    init = begun_with(command, config)
    from csph.training.loop import Hardware, train  # and Lightning, which takes seconds to import

    training, validation, data = views_of(command, config.crop)
    data |= config.data
    warn_of_inherited(init, validation)
    first = training[0].transients[0]
    for warning in level_warnings(config, first.height, first.width):
        log.warning("%s", warning)
    for name, begun in (("init", command.init), ("init_network", command.init_network)):
        if begun is not None:
            data[name] = Path(begun).name
    if command.codes_file is not None:
        _warn_of_dependent(codes_path(command.codes_file, folder))
    result = train(
        replace(config, data=data),
        training,
        validation,
        folder,
        init=init,
        hardware=Hardware(command.workers),
        progress=progress,
    )
    return {"model": config.model.name, "views": sum(len(views.transients) for views in training), **result}


def _warn_of_dependent(path: Path) -> None:
    """Warn of own codes that follow from each other: they tell a network nothing more."""
    _, coding = own_codes(path)
    rank = int(torch.linalg.matrix_rank(coding.tensor.flatten(1)))
    if rank < coding.codes:
        log.warning("%s: its %d codes have rank %d: the others follow from so many", path, coding.codes, rank)


def begun_with(command: Train, config: TrainConfig) -> WeightsOf | NetworkOf | None:
    """Return the model, or the model whose network alone, a training begins with; InputError for one that cannot."""
    begun = _begun_name(command)
    if begun is None:
        return None
    init = begin_with(checkpoint_of(begun), network_alone=command.init_network is not None)
    warn_of_unfinished(begun)
    check_init(init, config)
    return init


def warn_of_inherited(init: WeightsOf | NetworkOf | None, validation: Sequence[Views]) -> None:
    """Warn of validation views that a model to begin with, or one before it, was trained on."""
    if init is None or not init.seen:
        return
    number = sum(is_seen(view, init.seen) for views in validation for view in views.transients)
    if number:
        there = sum(len(views.transients) for views in validation)
        message = "the model to begin with was trained on %d of %d validation views: validation errors are too low"
        log.warning(message, number, there)


def folder_of(command: Train) -> Path:
    """Return the folder of a run: the one asked for, or one named after its options."""
    codes = f"{command.design.replace('+', '-')}-{'x'.join(map(str, command.block))}"
    codes = codes if command.codes_file is None else command.codes_file.stem
    return command.out or Path("out/train") / f"{codes}-{command.preset}-{command.seed}"


def network_method(model: DepthEstimator, *, overflows: list[int] | None = None, **reading: Any) -> Method:
    """Return depth of a histogram by a network; 16-bit sums that wrapped are appended to `overflows`.

    `reading` is passed on to `DepthModel.depth_of`: int8, int8_rule, decoder.
    """

    def method(histogram: Histogram) -> np.ndarray:
        depth, wrapped = model.depth_of(histogram, **reading)
        if overflows is not None:
            overflows.append(wrapped)
        return depth

    return method


def classical(name: str) -> Callable[[Tensor, Sensor], Tensor]:
    """Return depth [m] from counts (..., T) of a sensor without a network: by one of `METHODS`, or by CODE-K
    decoded by correlation, as in "fourier-8"."""
    if name in METHODS:
        return lambda counts, sensor: estimate_depth(counts, sensor, name)
    code = code_of(name)
    if code is None:
        raise InputError(f"baseline {name!r}: expected {', '.join(METHODS)} or CODE-K")

    def compressive(counts: Tensor, sensor: Sensor) -> Tensor:
        coding = _coding(*code, sensor)
        return decode_depth(encode(counts, coding), coding, sensor)

    return compressive


@lru_cache(maxsize=16)
def _coding(code: str, number: int, sensor: Sensor) -> CodingTensor:
    """One object for all images: the decoder keeps what it works out for a coding tensor."""
    return CodingTensor(f"{code}-{number}", temporal_code(code, number, sensor.bins, sensor))


def common_tile(models: Sequence[DepthModel]) -> tuple[int, int]:
    """Return rows and columns of the smallest tile that the blocks of all networks tile; 1 x 1 of none."""
    blocks = [(1, 1), *(model.config.block[1:] for model in models)]
    rows, columns = (math.lcm(*sides) for sides in zip(*blocks, strict=True))
    return rows, columns


def baseline(name: str) -> Method:
    """Return a method without a network, by the names of `classical`; `coates` undoes the law that made the histogram,
    where it lost photons."""
    if name in METHODS:
        return lambda histogram: histogram_depth_m(histogram, name)
    depth_of = classical(name)
    return lambda histogram: histogram_depth_m(histogram, depth_of)
