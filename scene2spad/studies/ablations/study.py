"""`study spatial-block`, `tensor-size` and `fourier`: designs of coding tensors beside each other, on one test set and
the same photons (supplement S.3.1 to S.3.3, Figures 6 to 12).

Models, results and rendered sets are shared with `study depth-offset` in one folder: what one has made, none repeats.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from csph.evaluation.methods import Evaluation, Row, as_dicts
from csph.levels import PHOTON_LEVELS
from scene2spad.networks import published
from scene2spad.networks.lookup import obtain, other_seeds, where_trained
from scene2spad.networks.registry import ModelSpec, Trained, ship_all
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, depth_map, evaluated, rendered
from scene2spad.options.experiments import Study
from scene2spad.studies.ablations import figures
from scene2spad.studies.ablations.plan import ALIKE_WITHIN, BETTER, CLAIMS, LEVELS, Claim, Sheet, sheets_of
from scene2spad.studies.depth_offset.plan import SHOWN_VIEWS, SMOKE, TEST_SET
from scene2spad.studies.depth_offset.tables import summary_rows
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress

NOT_IN_RUN = "not in this run"  # absent, or of another preset or compression


def run(command: Study, progress: Progress) -> dict:
    """Find or train the models, measure, decide the paper's conclusions, draw; tables and JSON in `command.out`."""
    smoke, folder = command.preset == "smoke", command.out / command.preset
    sheets = sheets_of(command.name, command.preset, command.full)
    wanted = list(dict.fromkeys(one for sheet in sheets for one in sheet.wanted))
    models = obtain(wanted, command, progress)
    shipped = ship_all([*models.found.values()]) if command.ship else []
    store, seed = Store(folder / "results"), command.seed
    count, size = (SMOKE.views, SMOKE.size) if smoke else (None, None)
    test = rendered(TEST_SET, folder / "sets", count=count, size=size, progress=progress)
    subjects = {one: model.subject for one, model in models.found.items()}
    claims = CLAIMS[command.name]
    again = other_seeds(dict.fromkeys(one for claim in claims for one in (claim.first, claim.second)), command)
    levels = sorted({level for sheet in sheets for level in sheet.shown}) if smoke else LEVELS
    shown = [view for view in SHOWN_VIEWS if view < len(test.views.scenes)]
    rows = evaluated(store, [*subjects.values()], test, levels, maps=shown, seed=seed, progress=progress)
    others = [model.subject for model in again.values()]
    repeated = evaluated(store, others, test, levels, seed=seed, progress=progress)
    # with the paper, models of its grid are compared as well; published numbers are means of all test levels
    twins = where_trained([replace(one, trained_on="published") for one in models.found], command)
    beside = {one: model.subject for one, model in twins.items()}
    pairs, pair_levels = (SMOKE.pairs, SMOKE.pair_levels) if smoke else (None, PHOTON_LEVELS)
    numbers: JsonObject = {
        "preset": command.preset,
        **models.described(),
        "conclusions": [decided(claim, [*rows, *repeated], {**models.found, **again}) for claim in claims],
        "published": published.compared(
            store, subjects | beside, pairs, pair_levels, (0.0,), seed=seed, progress=progress
        ),
        "summary": summary_rows(rows, models.found, {"set": TEST_SET}),
    }
    drawn = [
        _drawn(command, sheet, models.found, test, rows, store, shown[-1])
        for sheet in sheets
        if any(one in models.found for one in sheet.wanted)
    ]
    written = {"": as_dicts(rows), "-summary": numbers["summary"], "-published": numbers["published"]}
    made = [write_csv(table, command.out / f"{command.name}{name}.csv") for name, table in written.items() if table]
    path = command.out / f"{command.name}.json"
    with whole_file(path) as unfinished:
        unfinished.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    files = {"figures": [str(each) for each in drawn], "csv": [str(each) for each in made], "numbers": str(path)}
    return {**(numbers if command.json else _summary(numbers)), **files, "shipped": shipped}


def decided(claim: Claim, rows: Sequence[Row], models: Mapping[ModelSpec, Trained]) -> JsonObject:
    """Return a conclusion with its numbers: holds, does not hold, or not decided.

    The paired difference of MAE over scenes and levels decides, by its 95 % interval: `better` holds where it lies
    below 0 and does not where it lies above; `comparable` holds where it lies within ALIKE_WITHIN of the second's MAE,
    and does not where it lies outside. Where models were trained by several seeds it is of their means, and the means
    of every seed of one and every seed of the other have to say the same.
    """
    common = {"claim": claim.text, "says": f"{claim.first.name} {claim.relation} {claim.second.name}"}
    seeds = [[one.name for one in models if replace(one, seed=of.seed) == of] for of in (claim.first, claim.second)]
    missing = [one.name for one, names in zip((claim.first, claim.second), seeds, strict=True) if not names]
    if missing:
        return {
            **common,
            "levels": claim.levels,
            "verdict": "not decided",
            "why": f"{NOT_IN_RUN}: {', '.join(missing)}",
        }
    evaluation = Evaluation(list(rows))
    first, second = (_mean_mm(evaluation, names, claim.levels) for names in seeds)
    apart = evaluation.difference(seeds[0], seeds[1], claim.levels)
    each = [[_mean_mm(evaluation, [name], claim.levels) for name in names] for names in seeds]
    numbers = {"first_mm": first, "second_mm": second, "difference_mm": list(apart)}
    numbers |= {"first_seeds_mm": each[0], "second_seeds_mm": each[1]}
    found = verdict(claim.relation, apart, second)
    pairs = [(a - b, a - b, a - b) for a in each[0] for b in each[1]]
    if any(verdict(claim.relation, pair, second) != found for pair in pairs):
        found = "not decided"
    return {**common, "levels": claim.levels, **numbers, "verdict": found}


def _mean_mm(evaluation: Evaluation, names: Sequence[str], levels: str) -> float:
    """Return the MAE [mm] over scenes; NaN where there is no finite value."""
    interval = evaluation.interval(names, levels=levels)
    return math.nan if interval is None else interval.mean


def verdict(relation: str, apart: Sequence[float], second_mm: float) -> str:
    """Return what an interval (mean, low, high) of first - second says of a relation."""
    _, low, high = apart
    if not (np.isfinite(low) and np.isfinite(high)):
        return "not decided"
    if relation == BETTER:
        return "holds" if high < 0 else "does not hold" if low > 0 else "not decided"
    limit = ALIKE_WITHIN * second_mm
    if low > -limit and high < limit:
        return "holds"
    return "does not hold" if low > limit or high < -limit else "not decided"


def _drawn(
    command: Study,
    sheet: Sheet,
    models: Mapping[ModelSpec, Trained],
    test: TestSet,
    rows: Sequence[Row],
    store: Store,
    view: int,
) -> Path:
    mine = {one: models[one] for one in sheet.wanted if one in models}
    lines = []
    for level in sheet.shown:
        maps = [depth_map(store, one.subject, test, view, level, command.seed) for one in mine.values()]
        lines.append((f"{level[0]:g} + {level[1]:g}", test.truth_m(view), maps))
    labels = [figures.label_of(one) for one in mine.values()]
    path = command.out / f"{command.name}-{sheet.figure}-{sheet.compression}x.png"
    title = f"{sheet.title}, {sheet.compression}x, {TEST_SET}, seed 0"
    return figures.draw(title, labels, [one.name for one in mine], rows, lines, path)


def _summary(numbers: JsonObject) -> dict[str, list[str]]:
    """Summarise the study for the terminal: conclusions, MAE of every model, and the published numbers beside ours."""
    conclusions = []
    for one in numbers["conclusions"]:
        why = one.get("why") or "{:.1f} and {:.1f} mm, difference {:.1f} to {:.1f}, {} and {} seeds".format(
            one["first_mm"],
            one["second_mm"],
            *one["difference_mm"][1:],
            *(len(one[f"{which}_seeds_mm"]) for which in ("first", "second")),
        )
        conclusions.append(f"{one['claim']}: {one['verdict']} ({why})")
    table = [
        f"{line['design']} {line['compression']}x: {line['mae_mm']:.1f} mm, {line['within_10mm']:.1%} within 10 mm"
        for line in numbers["summary"]
        if line["levels"] == "all"
    ]
    beside = [
        f"{line['model']}: {line['near_mae_mm_label']:.1f} mm, published {line['near_published_mae_mm']} ({line['of']})"
        for line in numbers["published"]
    ]
    absent = numbers["absent"] or ["none"]
    return {"conclusions": conclusions, "mae": table, "published": beside or ["left out"], "absent": absent}
