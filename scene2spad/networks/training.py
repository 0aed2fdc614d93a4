"""`train` and `evaluate`: from the command line's words to csph's configuration, and results to files."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from csph import CodingTensor, decode_depth, encode, temporal_code
from csph.codes.design import Design
from csph.evaluation.methods import LEVEL_GROUPS, DepthEstimator, Evaluation, EvaluationPlan, Method, as_dicts, evaluate
from csph.evaluation.metrics import PHOTON_LEVELS
from csph.layer import SpatialStart
from csph.networks.model import DepthModel, load_model
from csph.training.config import ON_CPU, Front, ModelConfig, Network, TrainConfig, preset
from csph.training.views import Views, check_truth, read_views, split_views, training_parts
from csph.weights.cards import checkpoint_of
from csph.weights.shipped import checkpoint_name
from scene2spad.datasets.planes import random_planes
from scene2spad.datasets.renders import views_at
from scene2spad.datasets.workers import check_workers
from scene2spad.options.networks import Evaluate, Train, check_used
from scenes.errors import InputError, require
from scenes.files import write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.estimators.depth import METHODS, estimate_depth, histogram_depth_m
from spad.formats.histogram import Histogram
from spad.sensor.files import load_sensor
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")

PLANES = "planes"  # the set that needs no renderer
PLANE_SCENES = {"smoke": 20, "laptop": 2000, "laptop-v1": 2000, "workstation": 4000, "gpu": 4000, "paper": 13851}
SMOKE_PIXELS = 32
DEFAULT_COMPRESSION = 128.0


def config_of(command: Train) -> TrainConfig:
    """Return the preset with what the command line changes. Raises InputError for options that do not fit together."""
    described = load_sensor(command.sensor)
    require(described.zones is None, f"train: sensor {command.sensor} has zones, networks are for pixels")
    sensor = described.sensor
    network = command.network or _default_network(command)
    # the published network finds the pulse in the counts by itself; ours, of few layers, is given them matched
    uncoded: dict[str, Front] = {"none": "matched" if network == "compact" else "counts", "peak": "peak"}
    front = uncoded.get(command.design, "codes")
    design = None
    if front == "codes":
        design = Design.named(
            command.design, command.block, codes=command.codes, compression=_compression(command), full=command.full
        )
    _check_numbers(command)
    switches: tuple[str, ...] = command.layer
    layer = dict.fromkeys(switches, True)
    # the first models' and the published start, which their recipes reproduce
    start: SpatialStart = "uniform" if command.preset in ("paper", "laptop-v1") else "orthogonal"
    start = command.spatial_start or start
    start = start if design is not None and "spatial" in design.learned else "uniform"
    model = ModelConfig(
        front=front,
        design=design,
        layer=layer,
        network=network,
        sensor=sensor,
        grid=command.grid,
        spatial_start=start,
    )
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
    require(not command.init_share or command.init is not None, "train: --init-share needs --init")
    weights, sets = len(command.set_weights), len(command.set)
    require(weights in (0, sets), f"train: {weights} --set-weights for {sets} sets, expected one for each")


def _default_network(command: Train) -> Network:
    """Return the network of a preset: published with paper; refined for codes of several pixels, where training has the
    time for it; else compact."""
    if command.preset == "paper":
        return "published"
    bins, rows, columns = command.block
    coded = command.design not in ("none", "peak") and rows * columns > 1 and bins % 16 == 0
    return "refined" if coded and command.preset in ON_CPU else "compact"


def views_of(command: Train) -> tuple[list[Views], list[Views], dict[str, object]]:
    """Return training and validation views of every set, and the words that say which they are."""
    sets = [_views_of_set(path, command) for path in command.set]
    common = {"training": _paths(command.set), "validation": _paths(command.validation) or "its last scenes"}
    if command.validation:
        training, validation = sets, [read_views(path) for path in command.validation]
    else:
        parts = [split_views(views) for views in sets]
        training, validation = [first for first, _ in parts], [second for _, second in parts]
    return training, validation, {**common, "training_reach_m": max(map(training_reach_m, training))}


def _views_of_set(path: Path, command: Train) -> Views:
    if str(path) != PLANES:
        return read_views(path)
    pixels = SMOKE_PIXELS if command.preset == "smoke" else 64
    return random_planes(PLANE_SCENES[command.preset], size=pixels, seed=command.seed)


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
    from csph.training.beginning import NetworkOf
    from csph.training.loop import Hardware, train  # and Lightning, which takes seconds to import

    training, validation, data = views_of(command)
    require(command.init is None or command.init_network is None, "train: give --init or --init-network, not both")
    init: DepthModel | NetworkOf | None = None
    begun = command.init or command.init_network
    if begun is not None:
        init = load_model(checkpoint_of(begun))[0]
        init = NetworkOf(init) if command.init_network else init
        data["init" if command.init else "init_network"] = Path(begun).name
    folder = folder_of(command)
    result = train(
        replace(config, data=data),
        training,
        validation,
        folder,
        init=init,
        hardware=Hardware(command.workers, devices=command.devices or "auto"),
        progress=progress,
    )
    return {"model": config.model.name, "views": sum(len(views.transients) for views in training), **result}


def folder_of(command: Train) -> Path:
    """Return the folder of a run: the one asked for, or one named after its options."""
    name = f"{command.design.replace('+', '-')}-{'x'.join(map(str, command.block))}-{command.preset}-{command.seed}"
    return command.out or Path("out/train") / name


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
    code, _, number = name.rpartition("-")
    numbered = code != "" and number.isascii() and number.isdigit()
    require(numbered, f"baseline {name!r}: expected {', '.join(METHODS)}, or CODE-K")

    def compressive(counts: Tensor, sensor: Sensor) -> Tensor:
        coding = _coding(code, int(number), sensor)
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
    """Return a method without a network, by the names of `classical`."""
    depth_of = classical(name)
    return lambda histogram: histogram_depth_m(histogram, depth_of)


def photon_levels(texts: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Return mean (signal, background) photons of levels such as "1+100"; the paper's 16 of none. InputError for
    others."""
    found = []
    for one in texts:
        try:
            signal, background = map(float, one.split("+"))
        except ValueError:
            raise InputError(f"levels {one!r}: expected SIGNAL+BACKGROUND in photons a pixel, as in 1+100") from None
        fits = 0 < signal < math.inf and 0 <= background < math.inf
        require(fits, f"levels {one!r}: expected signal photons above 0 and background photons of 0 or more")
        found.append((signal, background))
    return tuple(found) or PHOTON_LEVELS


def run_evaluate(command: Evaluate, progress: Progress) -> dict:
    """Return networks and baselines on the same photons: one table (.csv), and the figures of the first checkpoint."""
    loaded = [load_model(checkpoint_of(path)) for path in command.checkpoints]
    require(bool(loaded), "evaluate: give at least one checkpoint")
    models = [model for model, _, _ in loaded]
    designs = group_names([config for _, config, _ in loaded], [*map(checkpoint_name, command.checkpoints)])
    require(command.int8 or command.int8_rule is None, "evaluate: --int8-rule goes with --int8")
    rule = command.int8_rule or "calibrated"
    in_8_bits = " int8" if rule == "calibrated" else f" int8 {rule}"
    sensor = models[0].config.sensor
    others = [model.config.sensor.name for model in models if model.config.sensor != sensor]
    require(not others, f"evaluate: checkpoints of sensors {sensor.name} and {', '.join(others)} see other photons")
    sensor.check_offset(command.offset)
    views = views_at(command.set)
    parts = training_parts(views)
    for path, (_, config, _) in zip(command.checkpoints, loaded, strict=True):
        _warn_of_training_views(str(path), config, parts, command.set)
    if command.views is not None:
        require(command.views >= 1, f"views {command.views} is below 1")
        views = Views(views.transients[: command.views], views.scenes[: command.views])
    check_truth(command.set, views, sensor, command.offset)
    overflows: list[int] = []
    methods: dict[str, Method] = {}
    groups: dict[str, list[str]] = {}
    for path, model, group in zip(command.checkpoints, models, designs, strict=True):
        for suffix, int8 in (("", False), (in_8_bits, True))[: 1 + command.int8]:
            read = {"int8": int8, "int8_rule": rule, "decoder": command.decoder}
            methods[f"{path}{suffix}"] = network_method(model, **read, overflows=overflows)
            groups.setdefault(f"{group}{suffix}", []).append(f"{path}{suffix}")
    methods |= {name: baseline(name) for name in command.baselines}
    groups |= {name: [name] for name in command.baselines}
    tile = common_tile(models) if command.tiled else (1, 1)
    plan = EvaluationPlan(photon_levels(command.levels), tile, command.offset, command.seed)
    found = evaluate(methods, views, sensor, plan, progress=progress)
    command.out.mkdir(parents=True, exist_ok=True)
    table = write_csv(as_dicts(found.rows), command.out / "evaluation.csv")
    first = f"{designs[0]}{in_8_bits if command.int8 else ''}"
    shown = results(found, groups, first, command.json)
    if command.levels:
        shown["by_level"] = by_level(found, groups, command.json)
    return {**shown, "overflows": sum(overflows), "csv": str(table)}


def _warn_of_training_views(name: str, config: TrainConfig, parts: dict[str, int], path: Path) -> None:
    """Say that a network has seen views of a test set in training; `parts`: `training_parts` of the set."""
    hashes = config.data.get("training_sha256", [])
    seen = [parts[one] for one in ([hashes] if isinstance(hashes, str) else hashes) if one in parts]
    if seen:
        log.warning("%s was trained on %d views of %s: its errors there are not those of a test", name, seen[0], path)


def _recipe(config: TrainConfig) -> str:
    same = replace(config, seed=0, threads=0, data={"training_sha256": config.data.get("training_sha256")})
    return json.dumps(same.to_dict(), sort_keys=True)


def group_names(configs: Sequence[TrainConfig], names: Sequence[str]) -> list[str]:
    """Name the group of each checkpoint: trainings of one design and recipe by different seeds are one group.

    A recipe is the training sets and every number of the configuration but the seed and the threads. Where one design
    was trained by several, a group is named after its first checkpoint, too.
    """
    recipes = [(config.model.name, _recipe(config)) for config in configs]
    several = {name for name, *_ in recipes if len({one for one in recipes if one[0] == name}) > 1}
    firsts = dict(reversed([*zip(recipes, names, strict=True)]))
    return [f"{one[0]} ({firsts[one]})" if one[0] in several else one[0] for one in recipes]


def by_level(found: Evaluation, groups: dict[str, list[str]], full: bool) -> list[str] | list[dict[str, object]]:
    """Return MAE [mm] and share within 10 mm of every level and group, means over scenes; as lines unless `full`."""
    lines: list[JsonObject] = []
    for signal, background in dict.fromkeys((row.signal, row.background) for row in found.rows):
        here = Evaluation([row for row in found.rows if (row.signal, row.background) == (signal, background)])
        for name, members in groups.items():
            found_here = {key: here.interval(members, figure=key) for key in ("mae_mm", "within_10mm")}
            means = {key: math.nan if one is None else one.mean for key, one in found_here.items()}
            lines.append({"signal": signal, "background": background, "method": name, **means})
    if full:
        return lines
    return [
        f"{line['signal']:g} + {line['background']:g} photons, {line['method']}: MAE {line['mae_mm']:.1f} mm, "
        f"{line['within_10mm']:.1%} within 10 mm"
        for line in lines
    ]


def results(found: Evaluation, groups: dict[str, list[str]], first: str, full: bool) -> dict[str, object]:
    """Return headline figures of the `first` group, every group by levels, paired differences of MAE from the first."""
    summaries = {name: found.summary(members) for name, members in groups.items()}
    everything = summaries[first]["all"]["all"]
    head = {key: everything[key] for key in ("mae_mm", "rmse_mm", "within_10mm", "ssim", "mae_interval_mm")}
    differences = {
        levels: {
            name: found.difference(groups[first], groups[name], levels)._asdict() for name in groups if name != first
        }
        for levels in LEVEL_GROUPS
        if found.values(groups[first], levels=levels)  # chosen levels may all be of one group
    }
    head = {"method": first, "trainings": len(groups[first]), **head}
    if not full:
        return {**head, "table": _lines(summaries), "bias_by_depth": _bias(summaries[first])}
    by_sbr = {
        name: {group: summary[group]["all"] for group in ("low_sbr", "high_sbr")} for name, summary in summaries.items()
    }
    return {**head, "by_sbr": by_sbr, "methods": summaries, "mae_difference_mm": differences}


def _lines(summaries: dict[str, dict]) -> list[str]:
    lines = [
        f"{'method':<40} {'MAE mm':>8} {'SBR > 0.1':>10} {'SBR <= 0.1':>11} {'mixed':>8} {'< 10 mm':>8} {'SSIM':>6}"
    ]
    for name, s in summaries.items():
        every = s["all"]["all"]
        mae = (every, s["high_sbr"]["all"], s["low_sbr"]["all"], s["all"]["mixed"])
        cells = [_cell(line["mae_mm"], f"{width}.1f") for line, width in zip(mae, (8, 10, 11, 8), strict=True)]
        cells += [_cell(every["within_10mm"], "8.1%"), _cell(every["ssim"], "6.3f")]
        lines.append(f"{name[-40:]:<40} {' '.join(cells)}")
    return lines


def _cell(value: float | None, form: str) -> str:
    return f"{math.nan if value is None else value:>{form}}"


def _bias(summary: dict) -> list[str]:
    return [
        f"{b['near_m']:g} to {b['far_m']:g} m: mean {b['mean_mm']:+.1f}, median {b['median_mm']:+.1f} mm, "
        f"{b['pixels']} pixels"
        for b in summary["bias_by_depth"]
    ]
