"""Refuse what `study` cannot do by its options alone: before torch, a model or a render, which take their time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from csph.codes.design import Design
from scene2spad.cli.checks import check_image, check_model
from scene2spad.cli.paths import holds_kind, input_file, output_folder
from scene2spad.options.common import only_for
from scene2spad.options.experiments import OPTIONS_OF, STUDIES, Study, trains_models
from scene2spad.options.networks import PLANES
from scenes.errors import InputError, require
from scenes.library.catalog import EXTENSIONS, load_scene
from scenes.library.sets import scene_set
from spad.sensor.model import PhotonBudget


def check_study(command: Study) -> None:
    """Raise InputError for options that do not apply to a study, numbers that are out of range, and files that are
    not there. Of `all`, options are those of any study."""
    names = STUDIES if command.name == "all" else (command.name,)
    if command.name != "all":
        purposes = {option: (command.name in of, f"study {', '.join(of)}") for option, of in OPTIONS_OF.items()}
        only_for(command, f"study {command.name}", purposes)
    _check_training(command, names)
    for one in command.checkpoints:
        check_model(one)
    checks: dict[str, Callable[[Study], None]] = {
        "tensors": _check_tensors,
        "power": _check_power,
        "codes": _check_scene,
        "render-error": _check_render_error,
        "real-data": _check_captures,
    }
    for name in names:
        if name in checks:
            checks[name](replace(command, name=name))


def _check_training(command: Study, names: tuple[str, ...]) -> None:
    """Check what models are trained on, and where they lie."""
    trains = any(trains_models(name, command) for name in names)
    used = trains or "depth-offset" in names
    only_for(command, f"study {command.name}", {"set": (used, "models that are trained (--retrain or --preset smoke)")})
    if command.set is not None and command.set != PLANES:
        _check_set(command.set)
    if command.models is None:
        return
    if trains:
        output_folder(command.models, "the models")
    require(command.models.is_dir() or (trains and not command.models.exists()), _no_folder(command.models))


def _check_set(path: Path) -> None:
    """Check that a set is one as far as a glance tells: a pack, or a folder with the index of a set."""
    require(path.exists(), f"{path}: file not found (--set)")
    if path.is_dir():
        require((path / "index.jsonl").is_file(), f"{path}: no set of scene2spad, it has no index.jsonl (--set)")
    else:
        require(holds_kind(path, "pack"), f"{path}: is no pack of scene2spad (--set)")


def _no_folder(path: Path) -> str:
    found = "is a file, expected a folder of models" if path.is_file() else "folder of models not found"
    return f"{path}: {found} (--models)"


def _check_tensors(command: Study) -> None:
    options = dict.fromkeys(("block", "codes"), (bool(command.design), "a --design"))
    if command.name == "tensors":
        only_for(command, "study tensors", options)
    if command.design:
        Design.named(command.design, command.block, codes=command.codes, full=command.full)


def _check_power(command: Study) -> None:
    PhotonBudget(command.signal, command.background)
    _check_scene(command)
    for name, size in (("width", command.width), ("height", command.height)):
        require(size % 4 == 0, f"{name} {size}: expected a multiple of 4, as 4 x 4 pixels share a core")


def _check_scene(command: Study) -> None:
    """Check size and scene; a scene in a file is loaded later, once."""
    check_image(f"study {command.name}", width=command.width, height=command.height)
    if Path(command.scene).suffix.lower() in EXTENSIONS:
        input_file(Path(command.scene))
    else:
        load_scene(command.scene, seed=command.seed, width=command.width, height=command.height)


def _check_render_error(command: Study) -> None:
    check_image("study render-error", width=command.width, height=command.height)
    of = scene_set(command.scene_set)
    most = of.size or 100
    require(1 <= command.views <= most, f"views {command.views} is outside 1 to {most} of set {of.name}")
    if command.cache is not None:
        output_folder(command.cache, "the renders")


def _check_captures(command: Study) -> None:
    for path in command.capture:
        input_file(path)
    if command.frame < 0:
        raise InputError(f"study real-data: --frame {command.frame} is below 0")
    only_for(command, "study real-data", {"frame": (bool(command.capture), "captures in files (--capture)")})
