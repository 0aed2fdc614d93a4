"""Dry run of `study`: the models that it asks for, what is kept of earlier runs, and the seconds of recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from csph.weights.cards import checkpoint_of
from csph.weights.shipped import WEIGHTS
from scene2spad.dry_runs.resources import memory
from scene2spad.dry_runs.training import step_seconds
from scene2spad.networks.lookup import OTHER_SEEDS, models_folder
from scene2spad.networks.registry import ModelRegistry, ModelSpec
from scene2spad.networks.training import config_of
from scene2spad.options.experiments import ABLATIONS, NO_PRESET, Study, trains_models
from scene2spad.options.networks import PLANES, TrainingPreset
from scene2spad.studies.every import TIMINGS
from scenes.io.inputs import read_whole_lines


def dry_run(command: Study) -> dict:
    """Return models, kept results, memory and seconds of one study, as far as they are known. InputError for a network
    that is given and is not there, and for another model under a wanted name."""
    wanted = wanted_models(command)
    folder = command.out / command.preset
    results = (command.out if command.name == "sim-to-real" else folder) / "results"  # keyed by all that it depends on
    trains = trains_models(command.name, command)
    there, missing = _found(wanted, command, shipped=not trains)
    beside, _ = _found(models_beside(command), command, shipped=not trains)
    given = given_networks(command)
    to_train = missing if trains else []
    training_s = sum(_training_seconds(one, command.preset) for one in to_train)
    earlier = recorded_seconds(command)
    of_preset = "" if command.name in NO_PRESET else " of this preset"
    basis = []
    if earlier:
        basis.append(f"the median of {len(earlier)} finished runs{of_preset} in {command.out}")
    if to_train:
        basis.append(f"{len(to_train)} trainings by some steps of each network on random counts")
    known = bool(earlier) or bool(to_train)
    preset = {} if command.name in NO_PRESET else {"preset": command.preset}
    return {
        "dry_run": True,
        "study": command.name,
        **preset,
        "models": {
            "there": [*(one.name for one in (*there, *beside)), *given],
            "to_train": [one.name for one in to_train],
            "left_out": [one.name for one in missing if one not in to_train],
        },
        "kept": {"results": _lines(results), "rendered_views": _views(folder / "sets")},
        "memory": memory(None),
        "estimate": {"seconds": (median(earlier) if earlier else training_s) if known else None},
        "basis": "; ".join(basis) or f"unknown: no run{of_preset} has been recorded here",
        "out": str(command.out),
    }


def given_networks(command: Study) -> list[str]:
    """Return the networks that a study of given ones is given. Raises InputError for one that is not there."""
    if command.name not in ("real-data", "render-error"):
        return []
    for one in command.checkpoints:
        checkpoint_of(one)
    return [str(one) for one in command.checkpoints]


def models_beside(command: Study) -> list[ModelSpec]:
    """Return the models that a study puts beside those that it asks for, where they are there."""
    if command.name == "multipath":
        from scene2spad.studies.multipath.plan import DELAYED, MIXED

        return [*MIXED, *DELAYED]
    if command.name not in ABLATIONS:
        return []
    from scene2spad.studies.ablations.plan import CLAIMS

    claimed = dict.fromkeys(one for claim in CLAIMS[command.name] for one in (claim.first, claim.second))
    again = [replace(one, seed=seed) for one in claimed for seed in OTHER_SEEDS]
    return [*again, *(replace(one, trained_on="published") for one in wanted_models(command))]


def wanted_models(command: Study) -> list[ModelSpec]:
    """Return the trained models that a study asks for; none of those that need none, or are given them."""
    found: tuple[ModelSpec, ...] = ()
    if command.name in ABLATIONS:
        from scene2spad.studies.ablations.plan import sheets_of

        sheets = sheets_of(command.name, command.preset, command.full)
        found = tuple(one for sheet in sheets for one in sheet.wanted)
    elif command.name == "depth-offset":
        from scene2spad.studies.depth_offset.plan import plan_of

        found = plan_of(command.preset, command.full).wanted
    elif command.name == "chip":
        from scene2spad.studies.chip.plan import plan_of as chip_plan

        found = chip_plan(command.preset).models
    elif command.name == "tdc":
        from scene2spad.studies.tdc.plan import plan_of as tdc_plan

        found = tdc_plan(command.preset).wanted
    elif command.name == "multipath":
        from scene2spad.studies.multipath.plan import MODELS as found
    elif command.name == "transport":
        from scene2spad.studies.transport.plan import MODELS as found
    elif command.name == "power":
        from scene2spad.studies.power.plan import WANTED as found
    return list(dict.fromkeys(found))


def recorded_seconds(command: Study) -> list[float]:
    """Return the seconds of finished runs of this study, and preset where it has some, into this folder."""
    found = []
    for line in read_whole_lines(command.out / TIMINGS):
        match line:
            case {"study": str(name), "preset": str(preset), "seconds": float(seconds) | int(seconds)}:
                if name == command.name and (name in NO_PRESET or preset == command.preset):
                    found.append(float(seconds))
    return found


def _found(wanted: Sequence[ModelSpec], command: Study, *, shipped: bool) -> tuple[list[ModelSpec], list[ModelSpec]]:
    """Return the models that are finished in the folder of runs or (`shipped`) in the package, and those that are in
    neither."""
    library = ModelRegistry(models_folder(command), WEIGHTS if shipped else None)
    there = [one for one in wanted if library.has(one)]
    return there, [one for one in wanted if one not in there]


def _training_seconds(one: ModelSpec, preset: TrainingPreset) -> float:
    config = config_of(one.command(preset, PLANES, Path()))
    return step_seconds(config)[0] * config.steps


def _lines(folder: Path) -> int:
    return (
        sum(sum(1 for _ in read_whole_lines(path)) for path in sorted(folder.glob("*.jsonl"))) if folder.is_dir() else 0
    )


def _views(folder: Path) -> int:
    return sum(1 for _ in folder.rglob("views/*.exr")) if folder.is_dir() else 0
