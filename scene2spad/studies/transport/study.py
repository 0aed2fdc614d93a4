"""`study transport`: what a renderer adds to RGB-D simulation, one step at a time, for every code.

Each scene is rendered once a laser with everything in it. From that render come all steps, so that geometry, truth and
mean counts are the same and nothing differs but what the step adds (`steps_of`). The MAE of every design at every step
stands in one table, and the ranking of codes at each step beside that of RGB-D rates: paired differences over scenes
decide (`ranking`). The same scenes as the planner renders them are compared with the full renders on photons that the
two share wherever their rates allow (`coupled`), beside the rays that the plan saved.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from csph.evaluation.methods import Row, as_dicts
from csph.networks.posterior import Decoder
from csph.training.views import Views
from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient, read_transient, write_transient
from scene2spad.bench.rendering.references import key_of
from scene2spad.networks.lookup import ModelLookup, found_only, obtain
from scene2spad.networks.registry import EvaluatedModel
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, evaluated
from scene2spad.networks.training import baseline
from scene2spad.options.experiments import Study
from scene2spad.studies.real_data.study import sun_and_sky
from scene2spad.studies.transport import figures
from scene2spad.studies.transport.plan import CHECKED, LASERS, LEVELS, LIMIT, MODELS, PLANS, STEPS, UNCOMPRESSED, Plan
from scene2spad.studies.transport.planned_renders import Place, planned_conclusions, planned_rows
from scene2spad.studies.transport.tables import Contender, Rows, conclusions, part_saved, ranking, summary
from scenes.errors import InputError, require
from scenes.files import append_line, finite, whole_file, write_csv
from scenes.io.inputs import read_whole_lines
from scenes.json_types import JsonObject
from scenes.library.sets import scene_set
from scenes.model import Ambient, Laser, Scene
from scenes.progress import Progress
from spad.formats.rgbd import transient_from_rgbd
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")

FORMAT = 1  # of results kept of methods without a network: another number forgets them


class WithoutNetwork:
    """A method of `training.baseline`, to be evaluated as models are."""

    def __init__(self, name: str) -> None:
        self._depth_of = baseline(name)

    def depth_of(self, histogram: Histogram, *, decoder: Decoder | None = None) -> tuple[np.ndarray, int]:
        return self._depth_of(histogram), 0


def without_network(name: str) -> EvaluatedModel:
    """Return a method without a network, whose results are kept by its name."""
    return EvaluatedModel(name, WithoutNetwork(name), hashlib.sha256(f"{name} {FORMAT}".encode()).hexdigest())


def run(command: Study, progress: Progress) -> dict:
    """Render, measure every design at every step, rank, compare plans; tables, JSON and figures in `command.out`."""
    plan, folder = PLANS[command.preset], command.out / command.preset
    models = _models(command, progress)
    contenders = contenders_of(plan, models)
    store = Store(folder / "results")
    places = [_place(*one, plan, command.seed, folder, progress) for one in _scenes(plan, command.seed)]
    rows = _measured(places, contenders, store, command.seed, progress)
    ranked = ranking(rows, contenders)
    checked = [one for one in contenders if one.name in CHECKED]
    planned = planned_rows(places, checked, (plan.draws, plan.most_draws), store, command.seed, progress)
    numbers: JsonObject = {
        "preset": command.preset,
        **models.described(),
        "steps": STEPS,
        "conclusions": conclusions(ranked),
        "planned_conclusions": planned_conclusions(planned),
        "scenes": [_described(place) for place in places],
        "summary": summary(rows, contenders),
        "ranking": ranked,
        "planned": planned,
    }
    _log_saved(numbers["scenes"], _seconds(folder))
    every = [{"laser": laser, "step": step, **row} for (laser, step), some in rows.items() for row in as_dicts(some)]
    tables = {"": every, **{f"-{name}": numbers[name] for name in ("summary", "ranking", "planned", "scenes")}}
    made = [write_csv(table, command.out / f"transport{name}.csv") for name, table in tables.items() if table]
    path = command.out / "transport.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    drawn = [
        figures.draw_steps(numbers["summary"], rows, command.out / "transport.png"),
        figures.draw_ranking(ranked, command.out / "transport-ranking.png"),
        figures.draw_planned(planned, numbers["scenes"], command.out / "transport-planned.png"),
    ]
    files = {"figures": [str(each) for each in drawn], "csv": [str(each) for each in made], "numbers": str(path)}
    return {**(numbers if command.json else _summary(numbers)), **files}


# Designs


def _models(command: Study, progress: Progress) -> ModelLookup:
    """Trained models, where there are any: this study has something to say without them."""
    if command.retrain:
        return obtain(MODELS, command, progress)
    return found_only(MODELS, command)


def contenders_of(plan: Plan, models: ModelLookup) -> list[Contender]:
    """Return the uncompressed estimator, codes decoded by correlation, and the networks that were found."""
    found = []
    for name in (UNCOMPRESSED, *plan.codes):
        ratio = 1 if name == UNCOMPRESSED else Sensor().bins // int(name.rpartition("-")[2])
        decoder = "likelihood" if name == UNCOMPRESSED else "correlation"
        found.append(Contender(without_network(name), decoder, ratio))
    for wanted, trained in models.found.items():
        found.append(Contender(trained.subject, "network", wanted.compression if wanted.coded else 1))
    return found


# Scenes and steps


def _scenes(plan: Plan, seed: int) -> Iterator[tuple[str, str, Scene]]:
    """Set, laser and scene of every place under every laser."""
    width, height = plan.size
    for some in plan.places:
        of = scene_set(some.set)
        for number in range(some.count):
            scene = of.view(number * of.views_per_place, seed=seed, width=width, height=height)
            message = f"scene {scene.name}: its laser is not at the camera, depth is not half the path"
            require(scene.laser.is_colocated, message)
            if some.sun:
                scene = replace(scene.without_lights(), ambient=Ambient(environment=sun_and_sky()))
            for laser in LASERS:
                yield some.set, laser, replace(scene, laser=Laser(laser))


def _place(name: str, laser: str, scene: Scene, plan: Plan, seed: int, folder: Path, progress: Progress) -> Place:
    progress(f"{scene.name}, {laser}", 0.0)
    full = rendered_once(scene, plan.full, seed, "full", folder, progress)
    # its noise is its own
    planned = rendered_once(scene, plan.planned, seed + 1, "planned", folder, progress)
    return Place(scene.name, name, laser, full, planned)


def rendered_once(
    scene: Scene, settings: RenderSettings, seed: int, kind: str, folder: Path, progress: Progress
) -> Transient:
    """Return from the folder or made now; seconds go to timings.jsonl beside the results."""
    key = key_of({"scene": scene.digest(), "laser": scene.laser.mode, "settings": asdict(settings), "seed": seed})
    path = folder / "renders" / f"{scene.name.replace('/', '-')}-{scene.laser.mode}-{kind}-{key}.exr"
    if path.is_file():
        try:
            return read_transient(path)
        except InputError:
            log.warning("%s: unreadable, made again", path)
    path.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    transient = render(scene, settings, seed=seed, progress=progress)
    common = {"scene": scene.name, "laser": scene.laser.mode, "kind": kind, "seconds": time.perf_counter() - start}
    write_transient(transient, path)
    append_line(folder / "timings.jsonl", json.dumps(common))
    return read_transient(path)


def steps_of(full: Transient) -> dict[str, Transient]:
    """Return what a sensor would see at each step, by the names of STEPS; truth and mixed pixels are the render's in
    all.

    rgbd        one return a pixel at 2 d, radiance albedo / (pi d^2); ambient light is the albedo
    cosine      times the cosine of incidence, from the depth image
    footprint   the render's direct light: every return of the pixel's footprint, several surfaces in it included
    indirect    and its indirect light
    ambient     and its ambient light
    """
    albedo = np.where(np.isfinite(full.depth_m), full.albedo, 0).astype(np.float32)
    flat = replace(full, ambient=albedo)

    def of_images(fov_deg: float | None) -> Transient:
        found = transient_from_rgbd(full.depth_m, albedo, albedo, fov_deg=fov_deg, meta=full.meta)
        return replace(found, mixed=full.mixed)

    kinds = (of_images(None), of_images(full.meta["camera"]["fov_deg"]), direct_alone(flat), flat, full)
    return dict(zip(STEPS, kinds, strict=True))


def direct_alone(transient: Transient) -> Transient:
    """Return its returns that met one surface."""
    kept = transient.bounces == 1
    before = np.concatenate(([0], np.cumsum(kept))).astype(np.int64)
    names = ("path_near_m", "path_far_m", "radiance", "bounces")
    return replace(
        transient, offsets=before[transient.offsets], **{name: getattr(transient, name)[kept] for name in names}
    )


def _measured(
    places: Sequence[Place], contenders: Sequence[Contender], store: Store, seed: int, progress: Progress
) -> Rows:
    """Rows of every design, scene and level at each laser's steps; RGB-D steps know no laser and are measured once."""
    found: dict[tuple[str, str], list[Row]] = {}
    subjects = [contender.subject for contender in contenders]
    for laser in LASERS:
        mine = [place for place in places if place.laser == laser]
        names, steps = tuple(place.name for place in mine), [steps_of(place.full) for place in mine]
        for step in STEPS:
            test = TestSet(f"{laser} {step}", Views(tuple(one[step] for one in steps), names))
            found[laser, step] = evaluated(store, subjects, test, LEVELS, seed=seed, progress=progress)
    return found


def _described(place: Place) -> JsonObject:
    """Describe a scene, and the rays of laser light that both renders traced."""
    full, planned = place.full.meta, place.planned.meta
    return {
        "scene": place.name,
        "set": place.set,
        "laser": place.laser,
        "indirect_share": place.full.indirect_fraction,
        "mixed_share": float(place.full.mixed.mean()),
        "full_rays": full["rays"],
        "planned_rays": planned["rays"],
        "rays_saved": 1 - planned["rays"] / full["rays"],
        "planned_bounces": planned["plan"]["bounces"],
        "planned_spp": planned["plan"]["spp"],
        "planned_grid": planned["plan"]["grid"],
        "planned_error": planned["relative_error"]["total"],
        "full_error": full["relative_error"]["total"],
    }


def _seconds(folder: Path) -> dict[tuple[str, str], dict[str, float]]:
    """{(scene, laser): {full, planned: seconds}}, the latest where something was rendered again."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for line in read_whole_lines(folder / "timings.jsonl"):
        match line:
            case {"scene": str(scene), "laser": str(laser), "kind": str(kind), "seconds": float(seconds)}:
                found.setdefault((scene, laser), {})[kind] = seconds
    return found


def _log_saved(scenes: Sequence[dict], seconds: Mapping[tuple[str, str], Mapping[str, float]]) -> None:
    for one in scenes:
        taken = seconds.get((one["scene"], one["laser"]), {})
        message = "{planned:.1f} s instead of {full:.1f} s".format(**taken) if len(taken) == 2 else "seconds not known"
        rays = f"{part_saved(one['rays_saved'])} of {one['full_rays']:.3g} rays saved"
        log.info("%s, %s: the plan: %s; %s", one["scene"], one["laser"], rays, message)


def _summary(numbers: JsonObject) -> dict[str, list[str]]:
    """Summarise the study for the terminal: how the codes rank, MAE of every design, planned renders, absent models."""
    changes = [
        f"{c['laser']}, {STEPS[c['step']]}: {c['ranking']} ({c['kept']} of {c['pairs']} pairs kept, {c['reversed']} "
        f"reversed, {c['not_decided']} not decided){''.join('; ' + one for one in c['turned'])}"
        for c in numbers["conclusions"]
        if c["levels"] == "all"
    ]
    mae = [
        f"{s['laser']}, {STEPS[s['step']]}, {s['design']}: {s['mae_mm']:.1f} mm "
        f"({s['mae_low']:.1f} to {s['mae_high']:.1f})"
        for s in numbers["summary"]
        if s["levels"] == "all" and s["pixels"] == "all"
    ]
    saved = {(s["scene"], s["laser"]): s["rays_saved"] for s in numbers["scenes"]}
    plans = [
        f"{c['scene']}, {c['laser']}: {part_saved(saved[c['scene'], c['laser']])} of the rays saved; MAE off by "
        f"{c['difference']:+.2%} +- {c['uncertain']:.2%} at most ({c['design']}), under {LIMIT:.0%}: {c['verdict']}"
        for c in numbers["planned_conclusions"]
    ]
    return {"ranking_of_codes": changes, "mae": mae, "planned": plans, "absent": numbers["absent"] or ["none"]}
