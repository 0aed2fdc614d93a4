"""`study chip`: trained codes through emulated cores to depth, beside the same models in floating point.

Every view is sensed once a photon level; the float model sees its counts, the chip its photons: int8 tables, 16-bit
sums that wrap, and the model's own network behind what leaves the sensor. The two are compared in pairs, by scene and
level. Float models are compiled a second time with HEADROOM_BITS, and a model that was trained for the chip is compared
with the float model that it began with. One view a model is interpreted photon by photon, and its integers compared
with the fast array's and torch's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from csph.evaluation.methods import Evaluation, Row, as_dicts
from csph.evaluation.metrics import paired_difference
from scene2spad.networks import published
from scene2spad.networks.lookup import obtain
from scene2spad.networks.registry import EvaluatedModel, ModelSpec, Trained
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, evaluated, rendered
from scene2spad.options.experiments import Study
from scene2spad.studies.chip.chain import ChipDepth, interpret
from scene2spad.studies.chip.code import codes_by_torch, compile_model, with_headroom
from scene2spad.studies.chip.plan import HEADROOM_BITS, ROOM_SIZE, TEST_SET, WITHIN, Plan, plan_of
from scenes.errors import InputError
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget, Sensor

_CHIP = " on the chip"
_HEADROOM = f", {HEADROOM_BITS} bit of headroom,"
_INTERPRETED = (50.0, 500.0)  # photons a pixel of the view that is interpreted


def run(command: Study, progress: Progress) -> dict:
    """Measure every model on every set; a table of all rows, one of the pairs, and JSON in `command.out`."""
    plan, folder = plan_of(command.preset), command.out / command.preset
    models = obtain(plan.models, command, progress)
    chips = {one: ChipDepth.of(compile_model(found.model, one.name)) for one, found in models.found.items()}
    subjects = [one for found in models.found.values() for one in _subjects(found, chips[found.wanted])]
    store, seed = Store(folder / "results"), command.seed
    still = rendered(TEST_SET, folder / "sets", count=plan.views, size=plan.size, progress=progress)
    rooms = rendered("rooms/test", folder / "sets", count=plan.rooms, size=plan.size or ROOM_SIZE, progress=progress)
    sets = {
        TEST_SET: evaluated(store, subjects, still, plan.levels, seed=seed, progress=progress),
        "rooms": evaluated(store, subjects, rooms, plan.other_levels, seed=seed, progress=progress),
    }
    pair_rows = _pairs(store, subjects, plan, seed, progress)
    peers = {one.name: one.plain.name for one in models.found if one.plain in models.found}
    peers |= {f"{one.name}{_HEADROOM}": one.name for one in models.found if not one.int8}
    compared: list[JsonObject] = []
    for name, rows in sets.items():
        levels = {(row.signal, row.background) for row in rows}
        compared += compared_rows(name, peers, _by_scene(rows), len(levels))
    if pair_rows:
        levels = {(row["signal"], row["background"]) for row in pair_rows}
        compared += compared_rows("published pairs", peers, _by_pair(pair_rows), len(levels))
    numbers: JsonObject = {
        **models.described(),
        "compared": compared,
        "interpreted": [_interpreted(one, chips[one], still, seed) for one in models.found],
        "pairs": "measured" if pair_rows else "left out: no photographs beside the project",
    }
    tables = {"": [{"set": name, **row} for name, rows in sets.items() for row in as_dicts(rows)]}
    tables |= {"-compared": compared, "-pairs": pair_rows}
    made = [write_csv(table, command.out / f"chip{name}.csv") for name, table in tables.items() if table]
    path = command.out / "chip.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    shown = numbers if command.json else _all_in_words(numbers)
    return {**shown, "csv": [str(each) for each in made], "numbers": str(path)}


def _subjects(found: Trained, chip: ChipDepth) -> tuple[EvaluatedModel, ...]:
    """Return the model on the chip; a float model also as it is, and on the chip with HEADROOM_BITS."""
    name = found.wanted.name
    by_chip = _by_chip(found, name, chip)
    if found.wanted.int8:
        return (by_chip,)
    smaller = ChipDepth.of(compile_model(with_headroom(found.model, HEADROOM_BITS), name))
    return found.subject, by_chip, _by_chip(found, f"{name}{_HEADROOM}", smaller)


def _by_chip(found: Trained, name: str, chip: ChipDepth) -> EvaluatedModel:
    """Return a model on the chip under a name: what its program and tables are is part of the digest."""
    return EvaluatedModel(f"{name}{_CHIP}", chip, chip.chip.digest(found.subject.digest))


def _pairs(
    store: Store, subjects: Sequence[EvaluatedModel], plan: Plan, seed: int, progress: Progress
) -> list[JsonObject]:
    """Return rows on the published pairs; none where the photographs are not at hand."""
    try:
        photographs = published.pairs(plan.pairs)
    except InputError:
        return []
    return published.errors_of(store, subjects, photographs, plan.other_levels, 0.0, seed=seed, progress=progress)


def _by_scene(rows: Sequence[Row]) -> dict[str, dict[str, np.ndarray]]:
    """{model: {scene: MAE [mm] of its views and levels}}"""
    evaluation = Evaluation(list(rows))
    return {name: evaluation.values([name]) for name in dict.fromkeys(row.method for row in rows)}


def _by_pair(rows: Sequence[JsonObject]) -> dict[str, dict[str, np.ndarray]]:
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        found.setdefault(row["model"], {}).setdefault(row["pair"], []).append(row["mae_mm_arrival"])
    return {name: {pair: np.array([values]) for pair, values in of.items()} for name, of in found.items()}


def compared_rows(
    name: str, peers: Mapping[str, str], values: Mapping[str, Mapping[str, np.ndarray]], levels: int
) -> list[JsonObject]:
    """Return a row a model on the chip, beside its float peer: MAE of both, and the paired difference as a fraction of
    the peer's, with its 95 % interval (over scenes). `holds` where no more than WITHIN is lost. Each scene has its
    values of every view at each of the photon `levels`."""
    rows = []
    for model, peer in peers.items():
        plain, chip = values[peer], values[f"{model}{_CHIP}"]
        mae, mae_chip = (float(np.mean([np.nanmean(v) for v in of.values()])) for of in (plain, chip))
        apart = paired_difference(chip, plain)
        fraction, low, high = (part / mae for part in apart)
        rows.append(
            {
                "set": name,
                "model": model,
                "beside": peer,
                "scenes": len(plain),
                "levels": levels,
                "float_mae_mm": mae,
                "chip_mae_mm": mae_chip,
                "difference": fraction,
                "low": low,
                "high": high,
                "holds": bool(high <= WITHIN) if np.isfinite(high) else None,
            }
        )
    return rows


def _interpreted(one: ModelSpec, chip: ChipDepth, test: TestSet, seed: int) -> JsonObject:
    """Interpret a view to its last photon: what the cores counted, and how its integers differ from two others."""
    compiled = chip.chip.compiled
    histogram = sense(test.views.transients[0], Sensor(), PhotonBudget(*_INTERPRETED), seed=seed)
    (down, right), (height, width) = compiled.block, histogram.depth_m.shape
    counts = histogram.counts[: height // down * down, : width // right * right]
    found = interpret(counts, compiled)
    fast, _ = chip.fast.frame(counts)
    counted = found.counters
    return {
        "model": one.name,
        "pixels": int(counts.shape[0] * counts.shape[1]),
        "photons": counted.photons,
        "cycles": counted.cycles,
        "wraps": counted.wraps,
        "differs_from_torch": int(np.count_nonzero(found.codes != codes_by_torch(counts, compiled))),
        "differs_from_fast": int(np.count_nonzero(found.codes != fast)),
    }


def in_words(row: JsonObject) -> str:
    """Write a row of `compared_rows` as a line; one scene has no interval."""
    message = f"{row['float_mae_mm']:.1f} mm in float, {row['chip_mae_mm']:.1f} on the chip"
    interval = interval_in_words(row["low"], row["high"], 2, "scene")
    return f"{row['set']}, {row['model'].rstrip(',')}: {message}, {row['difference']:+.2%} ({interval})"


def interval_in_words(low: float, high: float, decimals: int, of: str) -> str:
    """Write the ends of an interval, fractions, in per cent; one view or scene (`of`) has none."""
    if not np.isfinite(low):
        return f"no interval: one {of}"
    return f"{low:+.{decimals}%} to {high:+.{decimals}%}"


def _all_in_words(numbers: JsonObject) -> dict[str, list[str]]:
    lines = [in_words(row) for row in numbers["compared"]]
    emulated = [
        f"{row['model']}: {row['photons']:,} photons interpreted, {row['wraps']} wraps, {row['differs_from_torch']} "
        f"integers differ from torch, {row['differs_from_fast']} from the fast array"
        for row in numbers["interpreted"]
    ]
    return {"compared": lines, "interpreted": emulated, "absent": numbers["absent"] or ["none"]}
