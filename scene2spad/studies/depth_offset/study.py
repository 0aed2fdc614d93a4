"""`study depth-offset`: what learned codes know of depths that their training set did not have (supplement S.1).

Models trained on rooms of 0.5 to 7 m are tested on still lifes as they are and 7 m farther away: `time`, a delay with
every pixel's counts as they were, is the headline; `ray` and `rigid`, moved before rendering, stand beside it. Every
result is kept by the digests of model and view, so that a run that was stopped goes on, and the same photons meet
every model. Scenes are lit directly alone: what indirect light adds is not this study's question.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from csph.evaluation.methods import Row, as_dicts
from csph.networks.model import DepthModel
from csph.training.views import read_views, split_views
from scene2spad.networks import published
from scene2spad.networks.lookup import obtain
from scene2spad.networks.registry import EvaluatedModel, ModelSpec, Trained, ship_all, subject_of
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, depth_map, evaluated, rendered
from scene2spad.networks.training import training_reach_m
from scene2spad.options.experiments import Study
from scene2spad.options.networks import PLANES
from scene2spad.studies.depth_offset import figures, range_end, tables
from scene2spad.studies.depth_offset.plan import (
    OFFSET_M,
    RELIEF,
    SHOWN_LEVELS,
    SHOWN_VIEWS,
    TEST_SET,
    Level,
    Plan,
    plan_of,
)
from scenes.errors import InputError, require
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.offsets import OffsetMode
from scenes.progress import Progress

log = logging.getLogger("scene2spad")


@dataclass
class Session:
    """One run: what it stands on, and the rows that it has gathered so far. `trained_on` is --set: where models do not
    tell the depths of their training set, it does."""

    plan: Plan
    models: dict[ModelSpec, Trained]
    store: Store
    sets: Path
    seed: int
    progress: Progress
    trained_on: Path | None = None
    rows: list[dict] = field(default_factory=list)

    def named(self, wanted: Iterable[ModelSpec]) -> list[EvaluatedModel]:
        """Return those of them that were found."""
        return [self.models[one].subject for one in wanted if one in self.models]

    def one_seed(self) -> list[ModelSpec]:
        """Return seed 0 of every design at 128x."""
        return [w for w in self.plan.headline if w.coded and w.seed == 0 and w.compression == 128]

    @cached_property
    def reach_m(self) -> float | None:
        """The 99.9 % depth of the training sets, the largest where they differ; None where it is not told."""
        data = [t.config.data for w, t in self.models.items() if not w.time_offset_m]
        lines = [float(d["training_reach_m"]) for d in data if "training_reach_m" in d]
        if not lines and self.trained_on not in (None, PLANES):
            lines = [training_reach_m(split_views(read_views(self.trained_on))[0])]
        return max(lines, default=None)

    def measure(
        self,
        part: str,
        subjects: Sequence[EvaluatedModel],
        test: TestSet,
        levels: Sequence[Level],
        delay_m: float = 0.0,
        maps: Sequence[int] = (),
    ) -> list[Row]:
        """Return rows of a part of the study, kept for the table too."""
        moved = test.delayed(delay_m)
        found = evaluated(self.store, subjects, moved, levels, maps=maps, seed=self.seed, progress=self.progress)
        common = {"part": part, "set": test.name, "mode": test.mode, "offset_m": delay_m or test.offset_m}
        self.rows += [{**common, **row} for row in as_dicts(found)]
        return found

    def rendered(self, name: str, offset_m: float = 0.0, mode: OffsetMode = "time") -> TestSet:
        plan = self.plan
        return rendered(
            name, self.sets, offset_m=offset_m, mode=mode, count=plan.views, size=plan.size, progress=self.progress
        )


def run(command: Study, progress: Progress) -> dict:
    """Find or train the models, measure, draw; figures, tables and one JSON of all numbers in `command.out`."""
    plan, folder = plan_of(command.preset, command.full), command.out / command.preset
    models = obtain(plan.wanted, command, progress)
    shipped = ship_all([*models.found.values()]) if command.ship else []
    study = Session(plan, models.found, Store(folder / "results"), folder / "sets", command.seed, progress, command.set)
    _ = study.reach_m  # a bad --set is told now, not after an hour
    numbers, drawn = _measured_and_drawn(study, command.out)
    numbers = {"preset": command.preset, **models.described(), **numbers}
    written = {"": study.rows, "-summary": numbers["summary"], "-published": numbers["published"]}
    made = [write_csv(rows, command.out / f"depth-offset{name}.csv") for name, rows in written.items() if rows]
    with whole_file(command.out / "depth-offset.json") as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    shown = numbers if command.json else _summary(numbers)
    files = {"figures": [str(path) for path in drawn], "csv": [str(path) for path in made]}
    return {**shown, **files, "numbers": str(command.out / "depth-offset.json"), "shipped": shipped}


def _measured_and_drawn(study: Session, out: Path) -> tuple[JsonObject, list[Path]]:
    plan, here = study.plan, [w for w in study.plan.headline if w in study.models]
    base = study.rendered(TEST_SET)
    shown = [view for view in SHOWN_VIEWS if view < len(base.views.scenes)]
    all_models = study.named(here)
    near = study.measure("headline", all_models, base, plan.levels, maps=shown)
    far = study.measure("headline", all_models, base, plan.levels, OFFSET_M, maps=shown)
    summary = tables.summary_rows(near, here, {"set": TEST_SET, "mode": "time", "offset_m": 0.0})
    summary += tables.summary_rows(far, here, {"set": TEST_SET, "mode": "time", "offset_m": OFFSET_M})
    ratios = tables.ratio_rows(near, far, here)
    numbers: JsonObject = {
        "bars": tables.verdicts(ratios, here),
        "ratios": ratios,
        "modes": _modes(study, near, far),
        "relief": _relief(study),
        "sweep": _sweep(study, base),
        "range_end": _range_end(study, base),
        "cure": _cure(study, base),
        "swap": _swap(study, base),
        "energy": _energies(study),
        "published": _published(study),
        "summary": summary,
    }
    out.mkdir(parents=True, exist_ok=True)
    drawn = [
        figures.every_seed(ratios, numbers["bars"], out / "depth-offset-ratios.png"),
        *figures.tensors([study.models[w] for w in here], plan.compressions, out),
        figures.against_compression(summary, plan.levels, OFFSET_M, out / "depth-offset-2.png"),
        *_depth_images(study, base, shown, out),
    ]
    if numbers["sweep"]["curves"]:
        drawn.append(figures.sweep(numbers["sweep"], out / "depth-offset-sweep.png"))
    if numbers["range_end"]["walls"]:
        drawn.append(figures.range_end(numbers["range_end"], out / "depth-offset-range.png"))
    if numbers["cure"]:
        drawn.append(figures.bars_of(numbers["cure"], numbers["swap"], OFFSET_M, out / "depth-offset-cause.png"))
    energies = {w: study.models[w] for w in study.models if w.name in {e["model"] for e in numbers["energy"]}}
    if energies:
        drawn.append(figures.energy(energies, numbers["energy"], out / "depth-offset-energy.png"))
    return numbers, drawn


def _modes(study: Session, near: Sequence[Row], far: Sequence[Row]) -> list[dict]:
    """Seed 0 at 128x: MAE [mm] at the levels that all kinds of offset were measured at."""
    plan, one_seed = study.plan, study.one_seed()
    subjects, levels = study.named(one_seed), study.plan.space_levels
    found = {"as it is": near, "time": far}
    for mode in ("ray", "rigid") if subjects else ():
        moved = study.rendered(TEST_SET, OFFSET_M, mode)
        found[mode] = study.measure("space", subjects, moved, plan.space_levels)
    common = {"levels": [list(level) for level in levels]}
    return [
        {"model": s.name, **{mode: tables.mean_error(rows, s.name, levels) for mode, rows in found.items()}, **common}
        for s in subjects
    ]


def _relief(study: Session) -> list[dict]:
    """Measure the Middlebury reliefs as they are and 7 m farther in time: MAE [mm] of seed 0 at 128x."""
    plan, subjects = study.plan, study.named(study.one_seed())
    if not (plan.relief and subjects):
        return []
    try:
        test = study.rendered(RELIEF)
    except InputError as error:
        log.warning("the Middlebury reliefs are left out: %s", error)
        return []
    rows = [study.measure("relief", subjects, test, plan.relief_levels, moved) for moved in (0.0, OFFSET_M)]
    errors = [[tables.mean_error(part, s.name) for part in rows] for s in subjects]
    return [
        {"model": s.name, "near_mm": near, "far_mm": far, "ratio": far / near, "scenes": len(test.views.scenes)}
        for s, (near, far) in zip(subjects, errors, strict=True)
    ]


def _sweep(study: Session, base: TestSet) -> JsonObject:
    """MAE [mm] against the offset, where each design breaks, and where its training depths ended."""
    plan, test = study.plan, base.first(study.plan.sweep_views)
    mine = [w for w in (*study.one_seed(), ModelSpec("none"), *plan.cured) if w in study.models]
    rows = [study.measure("sweep", study.named(mine), test, plan.sweep_levels, metres) for metres in plan.sweep_m]
    curves = []
    for one in mine:
        errors = [tables.mean_error(part, one.name) for part in rows]
        broken = tables.break_m(plan.sweep_m, errors)
        curves.append({"model": one.name, "label": one.label, "mae_mm": errors, "breaks_at_m": broken})
    depth = sorted(float(d) for t in test.views.transients for d in t.depth_m.ravel() if d == d)
    reach, span = study.reach_m, [depth[0], depth[len(depth) // 2], depth[-1]]
    common = {"levels": [list(level) for level in plan.sweep_levels], "scenes": len(test.views.scenes)}
    # nearest, median and farthest pixel: the offset at which it leaves the training depths
    leaves = None if reach is None else [reach - depth_m for depth_m in span]
    ends = {"training_reach_m": reach, "test_depths_m": span, "leaves_training_at_m": leaves}
    return {"offsets_m": [*plan.sweep_m], "curves": curves, **ends, **common}


def _range_end(study: Session, base: TestSet) -> JsonObject:
    """Beyond what was decided beforehand: every seed up to the end of the range, which step fails there, and walls."""
    plan, test = study.plan, base.first(study.plan.sweep_views)
    mine = [w for w in (*plan.every_seed, *plan.cured) if w in study.models]
    arms = range_end.arm_rows(_arm_errors(study, [study.models[w] for w in mine if w.design == "fourier"], test))
    rows = {m: study.measure("range end", study.named(mine), test, plan.sweep_levels, m) for m in plan.end_m}
    first = [study.models[w] for w in mine if w.seed == 0]
    before_walls = [one.subject for one in first]
    before_walls += [range_end.arm(t, n) for t in first if t.wanted.design == "fourier" for n in range_end.DELAY_FREE]
    walls = [
        {"model": subject.name, **row}
        for subject in before_walls
        for row in range_end.wall_errors(study.store, subject, plan.walls_m, plan.wall_level, study.seed)
    ]
    return {
        "levels": [list(level) for level in plan.sweep_levels],
        "wall_level": list(plan.wall_level),
        "designs": range_end.seed_rows(rows, mine),
        "arms": arms,
        "observation": range_end.observation(arms, tables.BREAKS_AT),
        "walls": walls,
    }


def _arm_errors(study: Session, fixed: Sequence[Trained], test: TestSet) -> dict[tuple[str, float], list[float]]:
    """MAE [mm] of every seed of truncated Fourier, by what is changed and offset."""
    plan, errors = study.plan, {}
    for name in range_end.ARMS if fixed else ():
        # without a network all seeds are one
        models = fixed[:1] if name == "correlation" else fixed
        for metres in plan.end_m:
            subjects = [range_end.arm(one, name, metres) for one in models]
            found = study.measure("range end, arms", subjects, test, plan.sweep_levels, metres)
            errors[name, metres] = [tables.mean_error(found, s.name) for s in subjects]
    return errors


def _cure(study: Session, base: TestSet) -> list[dict]:
    """Long codes as trained and with random time offsets in training, and short codes: near and far MAE [mm]."""
    cured = [w for w in study.plan.cured if w in study.models]
    beside = [w for w in study.one_seed() if w.design == "learned" and w in study.models]
    if not cured:
        return []
    subjects = study.named([*beside, *cured])
    return _near_and_far(study, "cure", subjects, base)


def _near_and_far(study: Session, part: str, subjects: Sequence[EvaluatedModel], base: TestSet) -> list[dict]:
    levels = [level for level in SHOWN_LEVELS if level in study.plan.levels]
    levels = levels[:1] if part == "swap" else levels
    rows = [study.measure(part, subjects, base, levels, moved) for moved in (0.0, OFFSET_M)]
    return [
        {
            "model": s.name,
            "near_mm": tables.mean_error(rows[0], s.name),
            "far_mm": tables.mean_error(rows[1], s.name),
            "levels": [list(level) for level in levels],
        }
        for s in subjects
    ]


def _swap(study: Session, base: TestSet) -> list[dict]:
    """Put the codes of a biased model before the network of an unbiased one, and the other way round."""
    found = []
    for cured in study.plan.cured:
        plain = replace(cured, time_offset_m=0.0)
        if cured in study.models and plain in study.models:
            biased, unbiased = study.models[plain], study.models[cured]
            mixed = [swapped(biased, unbiased), swapped(unbiased, biased)]
            subjects = [biased.subject, *mixed, unbiased.subject]
            parts = [("biased", "biased"), ("biased", "unbiased"), ("unbiased", "biased"), ("unbiased", "unbiased")]
            rows = _near_and_far(study, "swap", subjects, base)
            found += [
                {"design": plain.label, "codes": codes, "network": network, **row}
                for (codes, network), row in zip(parts, rows, strict=True)
            ]
    return found


def swapped(codes: Trained, network: Trained) -> EvaluatedModel:
    """Return a model of one's codes and the other's network. InputError where the designs differ."""
    alike = codes.config.model == network.config.model
    require(alike, f"{codes.wanted.name} and {network.wanted.name} are of different designs: nothing to swap")
    model = DepthModel(codes.config.model)
    model.codes_layer.load_state_dict(codes.model.codes_layer.state_dict())
    model.network.load_state_dict(network.model.network.state_dict())
    model = model.to(next(codes.model.parameters()).device).eval()
    return subject_of(f"codes of {codes.wanted.name}, network of {network.wanted.name}", model)


def _energies(study: Session) -> list[dict]:
    """Energy of each long learned code beyond the training depths over that within, as trained and at its start."""
    reach = study.reach_m
    if reach is None:
        log.warning("the models do not tell their training depths: code energies are left out; --set SET would help")
        return []
    found = []
    for one, trained in study.models.items():
        energy = tables.energy_of(trained, reach)
        if energy is not None:
            bar = None if one.time_offset_m else energy.trained < tables.ENERGY_BAR
            common = {"model": one.name, "training_reach_m": reach, "at_start": energy.start}
            found.append({**common, "trained": energy.trained, "under_half": bar})
    return found


def _published(study: Session) -> list[dict]:
    """Our models on the Middlebury photographs in the published convention, beside what was published."""
    plan = study.plan
    mine = {w: study.models[w].subject for w in plan.headline if w.seed == 0 and w in study.models}
    return published.compared(
        study.store, mine, plan.pairs, plan.pair_levels, (0.0, OFFSET_M), seed=study.seed, progress=study.progress
    )


def _depth_images(study: Session, base: TestSet, shown: Sequence[int], out: Path) -> list[Path]:
    """Figure 3 at each compression: truth and estimates, near and far."""
    drawn = []
    levels = [level for level in SHOWN_LEVELS if level in study.plan.levels]
    for ratio in study.plan.compressions:
        mine = [w for w in study.plan.headline if w.seed == 0 and w in study.models]
        mine = sorted((w for w in mine if w.compression == ratio or not w.coded), key=lambda w: w.coded)
        if not any(w.coded for w in mine):
            continue
        lines = []
        for view in shown:
            for delay in (0.0, OFFSET_M):
                moved = base.delayed(delay)
                for level in levels:
                    maps = {
                        w.label: depth_map(study.store, study.models[w].subject, moved, view, level, study.seed)
                        for w in mine
                    }
                    message = f"{base.views.scenes[view].split('/')[-1]}\n{'+7 m' if delay else 'as it is'}\n"
                    lines.append((f"{message}{level[0]:g} + {level[1]:g}", moved.truth_m(view), maps))
        drawn.append(figures.depth_images(lines, ratio, out / f"depth-offset-3-{ratio}x.png"))
    return drawn


def _summary(numbers: JsonObject) -> dict[str, list[str]]:
    """Summarise the study for the terminal: the bars, every seed's ratio, the energies, where designs break, what fails
    far out."""
    holds = {True: "holds", False: "does not hold", None: "not decided"}
    bars = [f"{b['design']}: {b['geometric_mean']:.2f}, {b['bar']}: {holds[b['holds']]}" for b in numbers["bars"]]
    ratios = [
        f"{r['model']}: {r['near_mm']:.1f} mm, +7 m {r['far_mm']:.1f} mm, ratio {r['ratio']:.2f}"
        for r in numbers["ratios"]
    ]
    energy = [f"{e['model']}: {e['at_start']:.2f} at start, {e['trained']:.3f} trained" for e in numbers["energy"]]
    breaks = [
        f"{c['label']}: {'no break' if c['breaks_at_m'] is None else format(c['breaks_at_m'], '.1f') + ' m'}"
        for c in numbers["sweep"]["curves"]
    ]
    beside = [
        f"{p['model']}, {p['of']}: {p['near_mae_mm_label']:.1f} mm ({_number(p['near_published_mae_mm'])} published), "
        f"+7 m {p['far_mae_mm_label']:.1f} mm ({_number(p['far_published_mae_mm'])} published)"
        for p in numbers["published"]
    ]
    leaves = numbers["sweep"]["leaves_training_at_m"]
    if leaves is not None:
        ends = "training depths end for the nearest, median and farthest pixel at {:.1f}, {:.1f} and {:.1f} m"
        breaks.append(ends.format(*leaves))
    absent = numbers["absent"] or ["none"]
    return {
        "published": beside or ["left out"],
        "bars": bars,
        "ratios": ratios,
        "code_energy": energy,
        "breaks": breaks,
        "range_end_fourier": numbers["range_end"]["observation"] or ["left out"],
        "absent": absent,
    }


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"
