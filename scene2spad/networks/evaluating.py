"""`evaluate`: networks and baselines on the same photons, as one table and its means."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

from csph.evaluation.methods import LEVEL_GROUPS, Evaluation, EvaluationPlan, Method, as_dicts, evaluate
from csph.evaluation.metrics import INTERVAL_LEVEL
from csph.levels import PHOTON_LEVELS
from csph.networks.checkpoint import load_model, tensors_sha256
from csph.networks.config import TrainConfig
from csph.networks.model import DepthModel
from csph.training.lineage import count_seen
from csph.training.views import Views, check_truth, training_parts
from csph.weights.cards import checkpoint_of
from csph.weights.shipped import checkpoint_name
from scene2spad.datasets.renders import unsure_scenes, views_at
from scene2spad.methods import classical_method
from scene2spad.networks.depth_maps import check_free, map_writer
from scene2spad.networks.end_warnings import warn_of_ends, warn_of_unfinished
from scene2spad.networks.training import common_tile
from scene2spad.networks.unfinished import Unfinished
from scene2spad.options.networks import Evaluate
from scenes.errors import InputError, require
from scenes.files import whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")

FEW_SCENES = 6  # with fewer an interval is wider than the scenes are spread


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
        require((signal, background) not in found, f"levels {one!r}: given twice, whose pixels would count twice")
        found.append((signal, background))
    return tuple(found) or PHOTON_LEVELS


def run_evaluate(command: Evaluate, progress: Progress) -> dict:
    """Return networks and baselines on the same photons: one table (.csv) with what it is of (.json), and the figures
    of the first checkpoint."""
    levels, folder = photon_levels(command.levels), command.out / "maps"
    if command.maps:
        check_free(folder)
    loaded = [load_model(checkpoint_of(path)) for path in command.checkpoints]
    require(bool(loaded), "evaluate: give at least one checkpoint")
    models = [model for model, _, _ in loaded]
    check_different(models, command.checkpoints)
    designs = group_names([config for _, config, _ in loaded], [*map(checkpoint_name, command.checkpoints)])
    require(command.int8 or command.int8_rule is None, "evaluate: --int8-rule goes with --int8")
    rule = command.int8_rule or "calibrated"
    in_8_bits = " int8" if rule == "calibrated" else f" int8 {rule}"
    sensor = models[0].config.sensor
    others = [model.config.sensor.name for model in models if model.config.sensor != sensor]
    require(not others, f"evaluate: checkpoints of sensors {sensor.name} and {', '.join(others)} see other photons")
    sensor.check_offset(command.offset)
    whole = views_at(command.set)
    views = _first_views(whole, command)
    warn_of_seen(command, [config for _, config, _ in loaded], views, whole)
    check_truth(command.set, views, sensor, command.offset)
    overflows: list[int] = []
    unfinished = Unfinished(command.out / "unfinished")
    methods: dict[str, Method] = {}
    groups: dict[str, list[str]] = {}
    for path, model, group in zip(command.checkpoints, models, designs, strict=True):
        warn_of_unfinished(path)
        warn_of_ends(str(path), model.config, command.decoder)
        for suffix, int8 in (("", False), (in_8_bits, True))[: 1 + command.int8]:
            read = {"int8": int8, "int8_rule": rule, "decoder": command.decoder}
            methods[f"{path}{suffix}"] = unfinished.method(model, overflows, **read)
            groups.setdefault(f"{group}{suffix}", []).append(f"{path}{suffix}")
    methods |= {name: classical_method(name, sensor, seed=command.seed) for name in command.baselines}
    groups |= {name: [name] for name in command.baselines}
    tile = common_tile(models) if command.tiled else (1, 1)
    plan = EvaluationPlan(levels, tile, command.offset, command.seed, command.law)
    keep = map_writer(unfinished.maps, methods) if command.maps else None
    found = evaluate(methods, views, sensor, plan, progress=progress, keep=keep)
    unfinished.say()
    _report_plans(found, command.law)
    _warn_of_missing(found, groups)
    command.out.mkdir(parents=True, exist_ok=True)
    table = write_csv(as_dicts(found.rows), command.out / "evaluation.csv")
    first = f"{designs[0]}{in_8_bits if command.int8 else ''}"
    shown = results(found, groups, first, command.json)
    if command.levels:
        shown["by_level"] = by_level(found, groups, command.json)
    shown["laws"] = found.laws()
    shown |= _counted(found, command.set, sensor.recorded_range_m) | _scenes_counted(command.set, views)
    shown |= {"overflows": sum(overflows), "csv": str(table)}
    conditions = _conditions(command, views, sensor, tile)
    with whole_file(table.with_suffix(".json")) as beside:
        beside.write_text(json.dumps(conditions, indent=1) + "\n")
    unfinished.end(folder if command.maps else None)
    shown |= {"conditions": conditions} if command.json else {}
    return shown | ({"maps": str(folder)} if command.maps else {})


def _conditions(command: Evaluate, views: Views, sensor: Sensor, tile: tuple[int, int]) -> JsonObject:
    """Return what the numbers are of, beside the methods, scenes and levels that the table names."""
    return {
        "set": str(command.set),
        "views": len(views.transients),
        "offset_m": command.offset,
        "sensor": sensor.name,
        "seed": command.seed,
        "law": command.law or "by level",
        "decoder": command.decoder or "of each model",
        "tile": list(tile),
    }


def _first_views(whole: Views, command: Evaluate) -> Views:
    """Return the views of a set that are asked for. Raises InputError for more than there are."""
    if command.views is None:
        return whole
    there = len(whole.transients)
    fits = 1 <= command.views <= there
    require(fits, f"evaluate: views {command.views} is outside 1 to {there} of {command.set}")
    return Views(whole.transients[: command.views], whole.scenes[: command.views])


def _report_plans(found: Evaluation, law: str | None) -> None:
    """Log what the plans of all exposures say, each line once, and by default where pile-up was left out."""
    for message in found.plans.messages():
        log.log(logging.WARNING if message.startswith("warning:") else logging.INFO, "%s", message)
    left_out = found.plans.left_out
    if law is None and left_out is not None:
        log.info(
            "law: poisson, the default; in %d of %d exposures pile-up matters in the brightest pixel (up to %.2g%% "
            "primary detections a cycle: %s), which --law auto draws",
            left_out.exposures,
            found.plans.exposures,
            100 * left_out.pile_up,
            left_out.where,
        )


def _warn_of_missing(found: Evaluation, groups: dict[str, list[str]]) -> None:
    """Warn where some methods have no estimate in more pixels than others: their errors are of other pixels."""
    fractions = {name: _missing_fraction(found.counted(members)) for name, members in groups.items()}
    if len({*fractions.values()}) > 1:
        message = (
            "no estimate in some pixels (%s): MAE and RMSE leave them out, method by method; shares within a tolerance "
            "count them as not within it, and paired differences are of the pixels that both methods have"
        )
        log.warning(message, ", ".join(f"{name} {fraction:.2g}" for name, fraction in fractions.items() if fraction))


def _missing_fraction(counted: Mapping[str, int]) -> float:
    asked = counted["pixels"] + counted["missing"]
    return counted["missing"] / asked if asked else 0.0


def _counted(found: Evaluation, path: Path, range_m: float) -> JsonObject:
    """Count the pixels of all views that errors can be of, and those left out beyond the range, which a warning
    tells."""
    first = found.rows[0]
    one_level = (first.method, first.signal, first.background, "all")
    rows = [row for row in found.rows if (row.method, row.signal, row.background, row.group) == one_level]
    within, beyond = sum(row.pixels + row.missing for row in rows), sum(row.beyond_range for row in rows)
    if beyond:
        message = "%s: %d of %d pixels lie beyond the %.4g m that the sensor records: errors are of the others"
        log.warning(message, path, beyond, within + beyond, range_m)
    return {"pixels_within_range": within, "beyond_range": beyond}


def _scenes_counted(path: Path, views: Views) -> JsonObject:
    """Count the scenes that intervals are over, and the views whose scene is known by a name alone, which a warning
    tells."""
    scenes, unsure = len(set(views.scenes)), unsure_scenes(path, views)
    if unsure:
        message = (
            "%s: scenes of %d of %d views are known by name alone: intervals count each name as one scene, %d in all"
        )
        log.warning(message, path, unsure, len(views.scenes), scenes)
    if scenes == 1:
        log.info("a single scene has no 95 % interval")
    elif scenes < FEW_SCENES:
        log.info("95 %% intervals of %d scenes are wide, and trust their errors to be normal (Student)", scenes)
    return {"scenes": scenes, "unsure_scenes": unsure, "interval_level": INTERVAL_LEVEL}


def warn_of_seen(command: Evaluate, configs: Sequence[TrainConfig], views: Views, whole: Views) -> None:
    """Warn of networks that were trained on views they are evaluated on, or on the scenes of these, themselves or by
    way of those that they began with; `whole` is the set that the views are of."""
    parts = cache(lambda: training_parts(whole))
    for path, config in zip(command.checkpoints, configs, strict=True):
        seen = count_seen(checkpoint_of(path), config, views, parts)
        counts = {
            "was trained": (seen.own, seen.own_scenes),
            "began with a model that was trained": (seen.inherited, seen.inherited_scenes),
        }
        for how, (number, of_scenes) in counts.items():
            if number:
                message = "%s %s on %d views of %s: its errors there are not those of a test"
                log.warning(message, path, how, number, command.set)
            if of_scenes:
                message = "%s %s on scenes that %d%s views of %s show: its errors there are not those of other scenes"
                log.warning(message, path, how, of_scenes, " other" if number else "", command.set)
        if seen.unknown:
            message = "%s goes back to weights named %s; whether those were trained on views of %s is not recorded"
            log.info(message, path, ", ".join(seen.unknown), command.set)


def check_different(models: Sequence[DepthModel], paths: Sequence[Path]) -> None:
    """Raise InputError for the same weights given twice: they are one training, whatever they are called."""
    first: dict[tuple[str, str], Path] = {}
    for model, path in zip(models, paths, strict=True):
        # in half precision, in which models are shipped
        halved = tensors_sha256({name: value.half() for name, value in model.state_dict().items()})
        key = (halved, json.dumps(asdict(model.config), sort_keys=True))
        require(key not in first, f"evaluate: {first.get(key)} and {path} are the same weights; give them once")
        first[key] = path


def _recipe(config: TrainConfig) -> str:
    """Return what trainings by different seeds have in common, the weights that they began with included."""
    kept = {key: config.data.get(key) for key in ("training_sha256", "init_sha256")}
    # of the weights or the network alone; the names of the same weights do not count
    kept |= {"network_alone": "init_network" in config.data}
    return json.dumps(replace(config, seed=0, threads=0, data=kept).to_dict(), sort_keys=True)


def group_names(configs: Sequence[TrainConfig], names: Sequence[str]) -> list[str]:
    """Name the group of each checkpoint: trainings of one design and recipe by different seeds are one group.

    A recipe is the training sets, the weights that it begins with, and every number of the configuration but the seed
    and the threads. Where one design was trained by several, a group is named after its first checkpoint, too. A second
    checkpoint of one recipe and seed is no further training, and is a group of its own.
    """
    recipes: list[tuple[str, ...]] = []
    trainings = set()
    for config, name in zip(configs, names, strict=True):
        one = (config.model.name, _recipe(config))
        again = (one, config.seed) in trainings
        trainings.add((one, config.seed))
        recipes.append((*one, name) if again else one)
    several = {name for name, *_ in recipes if len({one for one in recipes if one[0] == name}) > 1}
    firsts = dict(reversed([*zip(recipes, names, strict=True)]))
    return [f"{one[0]} ({firsts[one]})" if one[0] in several else one[0] for one in recipes]


def by_level(found: Evaluation, groups: dict[str, list[str]], full: bool) -> list[str] | list[dict[str, object]]:
    """Return MAE [mm], share within 10 mm and missing estimates of every level and group, means over scenes; as lines
    unless `full`."""
    lines: list[JsonObject] = []
    for signal, background in dict.fromkeys((row.signal, row.background) for row in found.rows):
        here = Evaluation([row for row in found.rows if (row.signal, row.background) == (signal, background)])
        for name, members in groups.items():
            found_here = {key: here.interval(members, figure=key) for key in ("mae_mm", "within_10mm")}
            means = {key: math.nan if one is None else one.mean for key, one in found_here.items()}
            means |= here.counted(members)
            lines.append({"signal": signal, "background": background, "method": name, **means, "laws": here.laws()})
    if full:
        return lines
    return [
        f"{line['signal']:g} + {line['background']:g} photons, {line['method']}: MAE {line['mae_mm']:.1f} mm, "
        f"{line['within_10mm']:.1%} within 10 mm"
        + (f", {_missing_fraction(line):.1%} without an estimate" if line["missing"] else "")
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
    some = any(s["all"]["all"]["missing"] for s in summaries.values())
    head = f"{'method':<40} {'MAE mm':>8} {'SBR > 0.1':>10} {'SBR <= 0.1':>11} {'mixed':>8} {'< 10 mm':>8} {'SSIM':>6}"
    lines = [f"{head} {'missing':>8}" if some else head]
    for name, s in summaries.items():
        every = s["all"]["all"]
        mae = (every, s["high_sbr"]["all"], s["low_sbr"]["all"], s["all"]["mixed"])
        cells = [_cell(line["mae_mm"], f"{width}.1f") for line, width in zip(mae, (8, 10, 11, 8), strict=True)]
        cells += [_cell(every["within_10mm"], "8.1%"), _cell(every["ssim"], "6.3f")]
        cells += [_cell(_missing_fraction(every), "8.1%")] if some else []
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
