"""`study multipath`: networks beside the filter on all bins, where light takes several paths.

Every scene is rendered once under a flood laser, with indirect and ambient light. The same render without its indirect
light stands beside it, scaled to the same mean counts: what differs between the two is multipath alone. The background
falls from that of the training levels to nearly none.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from csph.evaluation.methods import Row, as_dicts
from csph.training.views import Views
from render.transient import Transient
from scene2spad.networks.lookup import ModelLookup, obtain, where_trained
from scene2spad.networks.registry import EvaluatedModel
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, evaluated
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import plain_log, plt, save
from scene2spad.plots.style import COLOURS, look
from scene2spad.studies.multipath.plan import DELAYED, FILTER, HEADLINE, LIGHTS, MIXED, MODELS, PEAK, PLANS, Plan
from scene2spad.studies.transport.study import direct_alone, rendered_once, without_network
from scenes.files import finite, whole_file, write_csv
from scenes.json_types import JsonObject
from scenes.library.catalog import load_scene
from scenes.model import Laser
from scenes.progress import Progress

log = logging.getLogger("scene2spad")

LOOKS = {FILTER: look(0) | {"color": "black", "marker": "*"}, PEAK: look(0) | {"color": COLOURS["grey"], "marker": "X"}}
LOOKS |= {one.name: look(n) for models in (MODELS, MIXED) for n, one in enumerate(models)}
LOOKS |= {
    one.name: look(number) for one, number in zip(DELAYED, (len(MODELS), 9), strict=True)
}  # black is the filter's
# a model trained on direct light -> the same design trained with indirect light
MIXED_NAMES = {plain.name: mixed.name for plain, mixed in zip(MODELS, MIXED, strict=True)}


def run(command: Study, progress: Progress) -> dict:
    """Render, measure every method on both kinds of light, compare; table, JSON and figure in `command.out`."""
    plan, folder = PLANS[command.preset], command.out / command.preset
    models = obtain(MODELS, command, progress)
    trained = models.found | where_trained((*MIXED, *DELAYED), command)
    subjects = [without_network(name) for name in (FILTER, PEAK)] + [one.subject for one in trained.values()]
    full = rendered_scenes(plan, folder, progress)
    names = tuple(name for name, _ in plan.scenes)
    lights = dict(zip(LIGHTS, (full, tuple(direct_alone(one) for one in full)), strict=True))
    rows = {
        light: evaluated(
            Store(folder / "results"), subjects, TestSet(light, Views(some, names)), plan.levels,
            seed=command.seed, progress=progress,
        )
        for light, some in lights.items()
    }  # fmt: skip
    numbers: JsonObject = {
        "preset": command.preset,
        **ModelLookup(trained, models.absent).described(),
        "lights": LIGHTS,
        "scenes": [_described(name, one) for name, one in zip(names, full, strict=True)],
        "summary": summary(rows, subjects, plan.levels),
        "by_scene": by_scene(rows, subjects, names),
    }
    numbers["conclusions"] = conclusions(numbers["summary"], numbers["by_scene"])
    command.out.mkdir(parents=True, exist_ok=True)
    every = [{"light": light, **row} for light, some in rows.items() for row in as_dicts(some)]
    table = write_csv(every, command.out / "multipath.csv")
    path = command.out / "multipath.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite(numbers), indent=1, allow_nan=False) + "\n")
    figure = draw(numbers["summary"], len(names), command.out / "multipath.png")
    shown = numbers if command.json else _summary(numbers)
    return {**shown, "figures": [str(figure)], "csv": [str(table)], "numbers": str(path)}


def rendered_scenes(plan: Plan, folder: Path, progress: Progress) -> tuple[Transient, ...]:
    """Return every scene under a flood laser at the camera, rendered into the folder where it is not there."""
    found = []
    for number, (name, seed) in enumerate(plan.scenes):
        progress(name, number / len(plan.scenes))
        scene = load_scene(name, seed=seed, width=plan.size[0], height=plan.size[1])
        scene = replace(scene, laser=Laser("flood"))
        found.append(rendered_once(scene, plan.settings, seed, "multipath", folder, progress))
    return tuple(found)


def _described(name: str, transient: Transient) -> JsonObject:
    error = transient.meta["relative_error"]["total"]
    return {"scene": name, "indirect_share": transient.indirect_fraction, "render_error": error}


def summary(rows: Mapping[str, Sequence[Row]], subjects: Sequence[EvaluatedModel], levels: Sequence) -> list[dict]:
    """Return MAE [mm] and share within 10 mm of every method, light and level: means over scenes, all pixels."""
    found = []
    for light, some in rows.items():
        for subject in subjects:
            for level in levels:
                mine = _of(some, subject.name, level)
                means = {name: float(np.mean([getattr(r, name) for r in mine])) for name in ("mae_mm", "within_10mm")}
                common = {"light": light, "method": subject.name, "signal": level[0], "background": level[1]}
                found.append({**common, **means})
    return found


def by_scene(rows: Mapping[str, Sequence[Row]], subjects: Sequence[EvaluatedModel], names: Sequence[str]) -> list[dict]:
    """Return MAE [mm] at HEADLINE, a row a scene and light."""
    return [
        {
            "scene": name,
            "light": light,
            **{s.name: next(r.mae_mm for r in _of(some, s.name, HEADLINE) if r.scene == name) for s in subjects},
        }
        for name in names
        for light, some in rows.items()
    ]


def _of(rows: Sequence[Row], method: str, level: tuple[float, float]) -> list[Row]:
    return [r for r in rows if r.group == "all" and r.method == method and (r.signal, r.background) == level]


def conclusions(means: Sequence[Mapping], scenes: Sequence[Mapping]) -> list[dict]:
    """Return of every network and light: MAE beside the filter's at HEADLINE, in how many scenes the filter is better,
    and what the least background does to it."""
    found = []
    methods = [name for name in dict.fromkeys(line["method"] for line in means) if name not in (FILTER, PEAK)]
    for light in dict.fromkeys(line["light"] for line in means):
        at = {(m["method"], m["signal"], m["background"]): m["mae_mm"] for m in means if m["light"] == light}
        least = min(background for _, signal, background in at if signal == HEADLINE[0])
        mine = [line for line in scenes if line["light"] == light]
        for name in methods:
            found.append(
                {
                    "light": light,
                    "network": name,
                    "mae_mm": at[name, *HEADLINE],
                    "filter_mae_mm": at[FILTER, *HEADLINE],
                    "filter_better_in": sum(line[FILTER] < line[name] for line in mine),
                    "scenes": len(mine),
                    "least_background": least,
                    "mae_mm_at_least_background": at[name, HEADLINE[0], least],
                    "filter_mae_mm_at_least_background": at[FILTER, HEADLINE[0], least],
                }
            )
    return found


def _summary(numbers: JsonObject) -> dict[str, list[str]]:
    """Summarise the study for the terminal: conclusions, indirect light of every scene, absent models."""
    lines = [in_words(one) for one in numbers["conclusions"]]
    scenes = [f"{s['scene']}: {s['indirect_share']:.0%} of the light is indirect" for s in numbers["scenes"]]
    return {"conclusions": lines, "scenes": scenes, "absent": numbers["absent"] or ["none"]}


def _counted(scenes: int) -> str:
    return f"{scenes} scene{'s' if scenes != 1 else ''}"


def in_words(c: Mapping) -> str:
    """Write a conclusion as a line, its errors at the least background where that is not HEADLINE's."""
    words = (
        f"{LIGHTS[c['light']]}, {c['network']}: {c['mae_mm']:.0f} mm at 50 + 50 photons, {FILTER} "
        f"{c['filter_mae_mm']:.0f} mm, the filter better in {c['filter_better_in']} of {_counted(c['scenes'])}"
    )
    if c["least_background"] == HEADLINE[1]:
        return words
    errors = f"{c['mae_mm_at_least_background']:.0f} and {c['filter_mae_mm_at_least_background']:.0f} mm"
    return f"{words}; at 50 + {c['least_background']:g} {errors}"


def draw(means: Sequence[Mapping], scenes: int, path: Path) -> Path:
    """Draw MAE under all light against the background, a panel a signal. Networks trained on direct light alone are
    dashed where the same design trained with indirect light is there."""
    mine = [line for line in means if line["light"] == "flood"]
    signals, methods = ([*dict.fromkeys(line[key] for line in mine)] for key in ("signal", "method"))
    figure, panels = plt.subplots(
        1, len(signals), figsize=(2 + 4.2 * len(signals), 5), layout="constrained", sharey=True, squeeze=False
    )
    for axes, signal in zip(panels[0], signals, strict=True):
        for method in methods:
            points = [
                [m[key] for m in mine if (m["method"], m["signal"]) == (method, signal)]
                for key in ("background", "mae_mm")
            ]
            direct = {"ls": "--", "mfc": "white"} if MIXED_NAMES.get(method) in methods else {}
            axes.plot(*points, ms=5, label=method, **LOOKS[method] | direct)
        axes.set_xscale("log")
        plain_log(axes)
        ticks = sorted({m["background"] for m in mine})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set(xlabel="mean background photons per pixel", title=f"{signal:g} signal photons")
        axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel("mean absolute depth error [mm]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    mean = "mean of " if scenes > 1 else ""
    dashed = (
        ". Dashed: the same designs, trained on direct light alone" if set(MIXED_NAMES.values()) & set(methods) else ""
    )
    figure.suptitle(f"Multipath under a flood laser: {mean}{_counted(scenes)}{dashed}", fontsize=11)
    return save(figure, path)
