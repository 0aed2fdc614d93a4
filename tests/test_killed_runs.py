"""SIGKILL at random moments of everything that takes long: the run that goes on ends with the same bytes.

Every run is killed with TMPDIR on the file system of its results, and on another, by turns: what a kill costs is
little beside the run to the end. Moments come from fixed seeds. SCENE2SPAD_KILLS asks for more of them than the slow
tests have time for.
"""

from __future__ import annotations

import os
import random
import shutil
import tempfile
from pathlib import Path

import pytest
from killed import Killed, Run, command, other_file_system, whole_run

KILLS = int(os.environ.get("SCENE2SPAD_KILLS", "3"))  # of each run
UNLIKE = ("timings.jsonl", "resume.ckpt")  # Lightning counts in its state how often a run went on

SET = ("--width", "12", "--height", "9", "--bounces", "1", "--grid", "2", "--count", "8", "--out", "out")
SMOKE = ("--preset", "smoke", "--out", "out")
SMALLER = """
from dataclasses import replace
from render.settings import RenderSettings
from scene2spad.studies import render_error
from scene2spad.studies.transport import plan as transport_plan
render_error.QUALITIES, render_error.FINE = ((1, 1), (2, 16)), (4, 64)
render_error.BOUNCES, render_error.DRAWS, render_error.LEVELS = 2, 2, ((10.0, 10.0),)
plan = transport_plan.PLANS["smoke"]
places = (transport_plan.Places("tabletop", 1, sun=True),)
transport_plan.PLANS["smoke"] = replace(plan, places=places, size=(12, 8), planned=RenderSettings(error=0.5))
"""
# Its 8 x 8 pixels are emulated whole; the front behind them has fewer photons.
SMALLER_POWER = """
from scene2spad.studies.power import front
front.PHOTONS, front._EMULATED_PHOTONS, front._COARSE = (550.0,), 1_000, ("coarse-64",)
"""
# Fewer models, captures, effects, poses and studies than the smoke plans have.
SMALLER_TDC = """
from dataclasses import replace
from scene2spad.studies.tdc import plan, study
small = replace(plan.SMOKE, models=plan.MODELS[1:2], tuned=(), on_chip=None, size=(12, 8))
study.plan_of = lambda preset: small
"""
SMALLER_SIM_TO_REAL = """
import numpy as np
from dataclasses import replace
from scene2spad.studies.sim_to_real import plan, pose, study
whole = study.read_plane_captures
study.read_plane_captures = lambda path: whole(path).chosen(np.arange(-18, 0))
small = replace(plan.SMOKE, every=2, pose_every=6, shown_m=(0.35,), nearest_m=0.0)
study.plan_of = lambda preset: small
study.FITTED = ("delay", "background")
study.SPANS, pose.ITERATIONS = ((0.1, 1.0),), 1
"""
SMALLER_ALL = """
from scene2spad.studies import every
every.STUDIES = ("memory", "codes", "fourier", "tensors")
"""
WALLS = """
from pathlib import Path
from render.transient.packs import write_pack
from scene2spad.datasets.planes import wall
if not Path("walls.h5").exists():
    write_pack([(wall(1.0 + 0.5 * n, 48), {"scene": f"walls/{n}"}) for n in range(2)], Path("walls.h5"))
"""
EVALUATE = ("evaluate", "learned-256x4x4-128x-s0", "none-s0", "--set", "walls.h5", "--baselines", "argmax", "--maps")
EVALUATE += ("--levels", "50+1", "10+10", "1+1")
RENDER_ERROR = ("study", "render-error", "--width", "12", "--height", "8", "--views", "1")
RUNS = {
    "dataset": Run(command("dataset", "hard-cases", *SET)),
    "dataset, 2 processes": Run(command("dataset", "hard-cases", *SET, "--workers", "2")),
    "dataset, planned": Run(
        command("dataset", "rooms", "--width", "8", "--height", "8", "--bounces", "1", "--count", "7", "--out", "out")
    ),
    "train": Run(command("train", "--preset", "smoke", "--threads", "1", "--steps", "24", "--out", "out"), UNLIKE),
    "evaluate": Run(command(*EVALUATE, "--out", "out", before=WALLS)),
    "codes": Run(command("study", "codes", "--width", "12", "--height", "8", "--out", "out")),
    "render-error": Run(command(*RENDER_ERROR, "--out", "out/study", "--cache", "out/cache", before=SMALLER)),
    "transport": Run(command("study", "transport", *SMOKE, before=SMALLER)),
    "power": Run(
        command("study", "power", "--scene", "plane", "--width", "8", "--height", "8", *SMOKE, before=SMALLER_POWER)
    ),
    "tdc": Run(command("study", "tdc", *SMOKE, before=SMALLER_TDC), UNLIKE),
    "sim-to-real": Run(command("study", "sim-to-real", *SMOKE, before=SMALLER_SIM_TO_REAL)),
    "all": Run(command("study", "all", "--width", "12", "--height", "8", *SMOKE, before=SMALLER_ALL), UNLIKE),
}
RUNS |= {
    name: Run(command("study", name, *SMOKE), UNLIKE)
    for name in ("depth-offset", "spatial-block", "tensor-size", "fourier", "real-data", "multipath", "chip")
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_killed_at_random_moments_a_run_ends_with_the_same_bytes(warm, tmp_path, name):
    """TMPDIR lies on another file system first, if there is one: a rename from there is a copy, and can be cut."""
    run, whole = RUNS[name], tmp_path / "whole"
    seconds = whole_run(warm, run, whole)
    places = [place for place in (other_file_system(tmp_path), tmp_path) if place is not None]
    tmpdirs = [Path(tempfile.mkdtemp(prefix="killed-runs-", dir=place)) for place in places]
    try:
        killed, moments = Killed(warm, run, whole, seconds, tmp_path / "run", tmpdirs[0]), random.Random(run.code)
        for number in range(KILLS):
            killed.tmpdir = tmpdirs[number % len(tmpdirs)]
            killed.kill(1, moments)
        killed.finish()
        assert not [left for tmpdir in tmpdirs for left in tmpdir.rglob("*")]
    finally:
        for tmpdir in tmpdirs:
            shutil.rmtree(tmpdir)
