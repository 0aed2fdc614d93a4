"""The worked changes of docs/extending.md: each diff applies to this tree, and the commands below it run."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import run_process

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "extending.md"
PACKAGES = ("scenes", "render", "spad", "csph", "ultraphase", "scene2spad")
# r exp(-r tau) counts a second, from a wall that every pixel sees alike: 400 primary detections in 1,000 cycles
PARALYSABLE = """
import numpy as np
import scene2spad as s2s
from spad.sensor.model import PhotonBudget, Sensor
from spad.detection.detect import sense
sensor = Sensor(bins=64, bin_width_s=1e-9, exposure_s=6.4e-5, dead_time_s=2e-7)
wall = s2s.render("plane", width=40, height=30, bounces=1)
counts = sense(wall, sensor, PhotonBudget(0, 400), model="paralysable", seed=1).counts.sum(axis=-1)
print(counts.mean(), counts.std() / counts.size**0.5)
"""


@pytest.fixture(scope="module")
def changed(tmp_path_factory) -> Path:
    """A copy of the packages with every diff of the page applied, one after the other."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    tree = tmp_path_factory.mktemp("changed")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tree / package, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    diffs = re.findall(r"```diff\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(diffs) == 5
    for diff in diffs:
        done = subprocess.run(["git", "apply", "-"], input=diff, text=True, cwd=tree, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
    return tree


def commands() -> list[list[str]]:
    lines = re.findall(r"^    scene2spad (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.slow
def test_the_commands_of_the_page_run_on_the_changed_tree(changed, tmp_path):
    asked = commands()
    assert len(asked) == 6
    for words in asked:
        small = ["--no-figure"] if words[0] not in ("study", "train") else []
        done = run_process([sys.executable, "-m", "scene2spad", *words, *small], cwd=tmp_path, env=of(changed))
        assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "steps.exr").is_file() and list(tmp_path.rglob("counts.png"))
    assert (tmp_path / "plain" / "model.safetensors").is_file() and list(tmp_path.glob("*network-plain*"))


def test_the_law_of_the_page_counts_what_its_closed_form_says(changed, tmp_path):
    done = run_process([sys.executable, "-c", PARALYSABLE], cwd=tmp_path, env=of(changed))
    mean, error = map(float, done.stdout.split())
    # 400 photons in 64 us of which dead time takes 0.2 us each; the first photon of a pixel finds it armed
    expected = 400 * np.exp(-400 * 2e-7 / 6.4e-5)
    assert abs(mean - expected) < 5 * error + 1


def test_the_loop_of_the_page_lowers_its_loss_without_a_change_to_the_package(tmp_path):
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    done = run_process([sys.executable, "-c", block], cwd=tmp_path, env=of(ROOT))
    assert done.returncode == 0, done.stderr
    losses = [float(one) for one in re.findall(r": ([\d.]+) m", done.stdout)]
    assert len(losses) == 4 and losses[-1] < losses[0] and (tmp_path / "gated.pt").is_file()


def of(tree: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(tree)}
