"""Render a scene to a transient, with a picture of its layers."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from render.settings import RenderSettings
from scene2spad.cli.checks import check_image
from scene2spad.cli.paths import file_stem, output_file, picture
from scene2spad.options.common import (
    Count,
    File,
    Long,
    Metres,
    Mode,
    Number,
    Offset,
    Pixels,
    Positional,
    check_indirect,
    may_stay_open,
    only_for,
    word,
)
from scenes import Ambient, InputError, Laser, Scene
from scenes.constants import DEFAULT_WAVELENGTH_M
from scenes.errors import require
from scenes.library.catalog import load_scene
from scenes.offsets import check_delay, check_offset
from scenes.optics.blackbody import sunlit_sky_w_per_m2_sr_nm
from scenes.placing import Placing
from scenes.progress import Progress

if TYPE_CHECKING:
    from render.transient import Transient

log = logging.getLogger("scene2spad")
SENSIBLE_DEPTH_M = (0.01, 1000.0)
MAX_LUX = 1e6


@dataclass(frozen=True, kw_only=True)
class Render(Long):
    """Render a scene's time-resolved radiance to a deep EXR file, with a picture beside it."""

    scene: Positional[Annotated[str, word("[SCENE]")]] = "living-room"
    """A name (see `scenes`), a mesh (.obj .ply .stl .glb), a Mitsuba scene (.xml), or a photograph with --depth."""
    out: File = None
    """The .exr file (default: the scene's name in this folder, - for /)."""
    width: Pixels = None
    """Image width, pixels (default: the scene's own, of an RGB-D pair the depth image's; one of width and height alone
    keeps the proportions)."""
    height: Pixels = None
    """Image height, pixels."""
    laser: Mode = None
    """Laser mode: it lights the field of view, the row being measured, or the pixel being measured (default: the
    scene's)."""
    baseline: Annotated[Metres, may_stay_open("X Y Z")] = None
    """Laser minus camera [m], in the camera's frame: x right, y down, z forward (default: the scene's)."""
    sunlight: Annotated[float | None, may_stay_open("LUX")] = None
    """Ambient light instead of the scene's own, lamps too: an even sky as bright as sunlight of this illuminance, at
    850 nm."""
    scale: Annotated[float | None, may_stay_open("METRES")] = None
    """Metres per unit of a mesh or an .xml (default: metres, or what a mesh's size suggests)."""
    up: Annotated[Literal["x", "y", "z"] | None, may_stay_open("{x,y,z}")] = None
    """Axis of a mesh that points up (default: z of .stl, else y)."""
    from_: Annotated[
        tuple[float, float, float] | None, tyro.conf.arg(name="from", metavar="X Y Z", help_behavior_hint="")
    ] = None
    """Camera position [m], y up (default: the scene's own)."""
    look_at: Annotated[Metres, may_stay_open("X Y Z")] = None
    """Point in the middle of the image [m] (default: the scene's own; with --from the middle of the scene)."""
    fov: Annotated[float | None, may_stay_open("DEGREES")] = None
    """Full horizontal angle of the camera (default: the scene's own)."""
    bare: bool = False
    """A mesh alone, without the floor and the wall that are put around it."""
    bounces: Count = None
    """Surfaces light may meet, 1 = direct only (default: planned from a pilot)."""
    spp: Count = None
    """Indirect light paths per pixel (default: planned from a pilot)."""
    filter: bool = False
    """Average late indirect light over small regions of surfaces: far less noise for the same paths, and a bias, which
    is measured and stated. Left out where a pilot sees little gain."""
    clamp: Number = None
    """Fireflies: one indirect path adds at most this many times the direct light around it (10, say); what that removes
    is measured and counted as an error (default: nothing is removed)."""
    grid: Count = None
    """Direct rays per pixel side (default: planned from a pilot)."""
    error: Number = None
    """Target of the relative error: nRMSE of the expected counts on the reference sensor (default: 0.02)."""
    budget: Annotated[tuple[float, float] | None, may_stay_open("SIGNAL BACKGROUND")] = None
    """Mean SIGNAL and BACKGROUND photons: render no finer than their shot noise can show, instead of --error."""
    ambient: Literal["auto", "on", "off"] = "auto"
    """Steady ambient light; auto renders it if the scene has any and the budget has background."""
    ambient_spp: Count = None
    """Ambient light paths per pixel (default: until its noise, in shares of its mean, is some seven times --error, or
    what the photons of --budget can show; 0.02 at least)."""
    offset: float = 0.0
    """Move the scene this many metres away."""
    offset_mode: Offset = "time"
    """time: identical counts, later; ray: every point along its camera ray; rigid: all of it, field of view matched."""
    depth: Annotated[Path | None, may_stay_open("FILE")] = None
    """Depth image (.png or .exr) of an RGB-D pair whose photograph is SCENE."""
    depth_scale: Annotated[float | None, may_stay_open("METRES")] = None
    """Metres per level of the depth image; a .png needs it, an .exr is taken in metres."""
    focal: Annotated[float | None, may_stay_open("PIXELS")] = None
    """Focal length of the depth image, pixels; an RGB-D pair needs it."""
    cosine: bool = False
    """RGB-D: apply the cosine of the surface to the photograph, which already holds shading of its own."""
    refraction: Literal["auto", "straight", "bent"] = "auto"
    """Thick glass: bent refracts direct light of a laser at the camera; auto does where there is any."""
    figure: bool = True
    """Draw a picture of the layers beside the file."""


def run(command: Render, progress: Progress) -> dict:
    """Run the command: scene -> .exr and a picture of its layers."""
    check_image("render", width=command.width, height=command.height)
    from render.engine import render
    from render.transient import write_transient
    from scene2spad.plots import figures

    check_indirect(command, "render", command.bounces, ("spp", "filter", "clamp"))
    settings = _settings(command)
    check_offset(command.offset)
    only_for(command, "render", {"offset_mode": (command.offset != 0, "a scene that is moved (--offset)")})
    _check_ambient(command)
    if command.out is not None:
        output_file(command.out, ".exr", "transient", figure=command.figure)
    scene = _load(command)
    named = Path(f"{file_stem(scene.name)}.exr")
    out = command.out or output_file(named, ".exr", "transient", figure=command.figure)
    scene = _lit(scene, command)
    start = time.perf_counter()
    if command.offset and command.offset_mode == "time":
        check_delay(scene.laser.baseline_m)
    if command.offset and command.offset_mode != "time":
        from scene2spad.datasets.moving import moved

        scene = moved(scene, command.offset, command.offset_mode)
    if command.dry_run:
        from scene2spad.dry_runs.rendering import dry_run

        return dry_run(scene, settings, command.seed) | {"out": str(out)}
    transient = in_view(render(scene, settings, seed=command.seed, progress=progress))
    seconds = time.perf_counter() - start
    if command.offset and command.offset_mode == "time":
        transient = transient.delayed(command.offset)
    _question_unit(transient, scene.name)
    write_transient(transient, out)
    error, plan = transient.meta["relative_error"], transient.meta["plan"]
    result = {
        "seconds": seconds,
        "rays": transient.meta["rays"],
        "spp": plan["spp"],
        "returns": transient.returns,
        "indirect_fraction": transient.indirect_fraction,
        "relative_error": error["total"],
        "pixel_error_median": error["pixel_median"],
        "pixel_error_p95": error["pixel_p95"],
        "plan": plan,
        "out": str(out),
    }
    if command.figure:
        result["figure"] = str(figures.draw_transient(transient, picture(out, "transient")))
    return result | {"target_met": transient.meta["target_met"]}


def _settings(command: Render) -> RenderSettings:
    return RenderSettings(
        bounces=command.bounces,
        spp=command.spp,
        filter=command.filter,
        clamp=command.clamp,
        refraction={"auto": None, "straight": "straight", "bent": "bent"}[command.refraction],
        grid=command.grid,
        ambient={"auto": None, "on": True, "off": False}[command.ambient],
        ambient_spp=command.ambient_spp,
        error=command.error,
        budget=command.budget,
    )


def _load(command: Render) -> Scene:
    given = (command.depth, command.focal, command.depth_scale)
    if command.cosine or any(value is not None for value in given):
        return _rgbd(command)
    return load_scene(
        command.scene, seed=command.seed, width=command.width, height=command.height, placing=_placing(command)
    )


def _placing(command: Render) -> Placing:
    return Placing(command.up, command.scale, command.from_, command.look_at, command.fov, command.bare)


def _lit(scene: Scene, command: Render) -> Scene:
    """Return the scene under the laser and the ambient light that are asked for."""
    laser = scene.laser
    if command.laser is not None:
        laser = Laser(command.laser, laser.baseline_m)
    if command.baseline is not None:
        laser = replace(laser, baseline_m=command.baseline)
    if command.sunlight is None:
        return replace(scene, laser=laser)
    sky = Ambient(radiance=sunlit_sky_w_per_m2_sr_nm(command.sunlight, DEFAULT_WAVELENGTH_M))
    return replace(scene.without_lights(), laser=laser, ambient=sky)


def _check_ambient(command: Render) -> None:
    """Refuse light and paths that are asked for where ambient light is turned off."""
    lux, spp = command.sunlight, command.ambient_spp
    message = f"--ambient-spp {spp} and --ambient off contradict each other; leave one of them out"
    require(spp is None or command.ambient != "off", message)
    if lux is None:
        return
    require(0 <= lux <= MAX_LUX, f"--sunlight {lux:g} lux is outside 0 to {MAX_LUX:g}")
    message = f"--sunlight {lux:g} lux and --ambient off contradict each other; leave one of them out"
    require(lux == 0 or command.ambient != "off", message)


def _question_unit(transient: Transient, name: str) -> None:
    """Warn of depths that no laser range finder of this kind looks at: the file's unit is then probably not metres."""
    seen = transient.depth_m[np.isfinite(transient.depth_m)]
    median = float(np.median(seen)) if seen.size else 1.0
    if not SENSIBLE_DEPTH_M[0] <= median <= SENSIBLE_DEPTH_M[1]:
        log.warning(
            "warning: the median depth of %s is %.4g m; if its unit is not metres, say so by --scale", name, median
        )


def _rgbd(command: Render) -> Scene:
    """Return the relief of a photograph and its depth image."""
    from scenes.io.relief import RgbdFiles, rgbd

    require(_placing(command) == Placing(), f"{command.scene}: an RGB-D pair has its own size and camera")
    if command.depth is None or command.focal is None:
        raise InputError(f"{command.scene}: an RGB-D pair needs --depth FILE and --focal PIXELS (and --depth-scale)")
    files = RgbdFiles(Path(command.scene), command.depth, command.focal, command.depth_scale, command.cosine)
    return rgbd(files, width=command.width, height=command.height)


def in_view(transient: Transient) -> Transient:
    if transient.returns == 0:
        raise InputError(f"scene {transient.meta['scene']}: nothing in view of the camera returns light")
    return transient
