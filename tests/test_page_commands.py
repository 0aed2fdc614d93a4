"""Every command and Python block of the front page and of the how-to pages is run, in the order of the page.

The pages' words are run as they stand, but that sizes are small: `SMALL` replaces or adds options. Each page begins in
a folder of its own with the files that a reader has at hand. What is not run is in `NOT_RUN`, with the reason.
"""

import contextlib
import re
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent / "scene2spad"))

from deepinv_stand_in import provide_deepinv
from test_readability import PAGES, ROOT

from scene2spad.cli.main import main
from scene2spad.options.experiments import NO_PRESET
from spad.sensor.files import read_sensor

# Options of a command that are small here: as they stand in place of the page's, or added.
SMALL = {
    "render": {"--width": "16", "--height": "12", "--bounces": "1"},
    "dataset": {"--width": "16", "--height": "12", "--bounces": "1", "--count": "8", "--workers": "1"},
    "train": {"--preset": "smoke", "--steps": "4"},
    "evaluate": {"--views": "1"},
    "study": {"--preset": "smoke"},
    "inspect": {"--pixel": "6 8"},
    "calibrate": {"--every": "8"},
}
NOT_RUN = {
    "scene2spad render": "names the command within a sentence",
    "make demo": "makes an environment and downloads; CI's set-up does it, and test_cli runs `demo`",
    "make test": "runs these tests",
    "make docs": "needs the generator of the pages, which the tests do not install",
    "pip install --constraint constraints.txt .": "installs into the environment that runs the tests",
    "pip install 'scene2spad[video]'": "downloads 70 MB",
    "pip install 'scene2spad[cluster]'": "installs what the tests have",
    "pip install deepinv": "downloads gigabytes; the operator was tried with it, here a stand-in takes its place",
    "scene2spad train --preset gpu --set rooms.h5 --out run-gpu": "needs a GPU",
    "scene2spad study depth-offset": "trains networks for hours; test_depth_offset runs it small",
    "scene2spad study real-data --capture FILE": "test_real_data runs it; needs trained networks beside the capture",
    "make notebooks": "jupytext is an extra; test_examples checks the cells",
    'eval "$(scene2spad --completion bash)"': "test_cli_words lets bash run the script",
    "python tools/set_error.py FOLDER": "renders with 256 paths a pixel; test_set_error runs it",
}
STARTS = ("scene2spad", "dask", "make", "pip", "python", "jupytext", "eval")
INLINE = re.compile(rf"`((?:{'|'.join(STARTS)}) [^`]+)`")
FENCE = re.compile(r"^```(\w*)$")

SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/>
        <integer name="height" value="12"/></film></sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="3"/><translate z="-2"/></transform>
        <bsdf type="diffuse"/></shape>
    <shape type="sphere"><point name="center" z="2"/><float name="radius" value="0.3"/></shape>
    </scene>"""


def steps(page: Path) -> Iterator[tuple[str, str]]:
    """Yield ("python", block), ("toml", block) and ("command", line) in the order of a page."""
    kind, block, waiting = None, "", ""
    for line in page.read_text(encoding="utf-8").splitlines():
        fence = FENCE.match(line)
        if fence:
            if kind in ("python", "toml"):
                yield kind, block
            kind, block = (fence[1] if kind is None else None), ""
        elif kind in ("python", "toml"):
            block += line + "\n"
        elif kind is not None or line.startswith("    "):
            waiting += line.strip().removesuffix("\\") + " "
            if not line.endswith("\\"):
                if waiting.split()[:1] and waiting.split()[0] in STARTS:
                    yield "command", waiting.strip()
                waiting = ""
        else:
            yield from (("command", words) for words in INLINE.findall(line) if words.split()[1:])


def words_of(command: str) -> list[str]:
    return shlex.split(command, comments=True)


def shrunk(words: list[str]) -> list[str]:
    """The words with the small options of their command."""
    small = dict(SMALL.get(words[0], {}))
    if words[0] == "render" and words[1].endswith(".png"):
        small = {"--bounces": "1"}  # the photograph says the size
    if "--dry-run" in words or (words[0] == "study" and ("--preset" in words or words[1] in NO_PRESET)):
        small = {"--crop": "8"} if words[0] == "train" else {}  # the views are small, and a dry run says so
    kept, skipping = [], False
    for word in words:
        if word.startswith("--"):
            skipping = word in small
        if not skipping:
            kept.append(word)
    return kept + [part for name, value in small.items() for part in (name, *value.split())]


def _meshes(folder: Path) -> None:
    knot = trimesh.creation.torus(0.3, 0.1)
    for name, scale in (("dragon.ply", 1), ("part.obj", 1), ("part.stl", 1000), ("my.glb", 1)):
        knot.copy().apply_scale(scale).export(folder / name)
    (folder / "my.xml").write_text(SCENE)


def _photograph(folder: Path) -> None:
    depth = np.full((12, 16), 1500, np.uint16)
    depth[4:8, 4:8] = 1200
    Image.fromarray(depth).save(folder / "depth.png")
    Image.fromarray(np.full((12, 16), 128, np.uint8)).save(folder / "photo.png")


def _foreign(folder: Path) -> None:
    """A frame, a capture and a checkpoint as the published family leaves them."""
    import scipy.sparse
    from test_interchange import published_checkpoint

    from spad.formats.linospad import Capture, write_linospad

    counts = scipy.sparse.random(1536, 16, 0.02, "csc", rng=np.random.default_rng(0))
    counts.data = np.ceil(9 * counts.data)
    write_linospad([Capture(counts, np.arange(16.0).reshape(4, 4))] * 4, folder / "capture.mat")
    published_checkpoint(folder / "epoch=6.ckpt")


def run(line: str) -> None:
    assert main(shrunk(words_of(line)[1:])) == 0, line


@pytest.fixture(scope="session")
def had(tmp_path_factory) -> Path:
    """What a reader has before a page: own meshes, scenes, sensor, photograph, and what earlier pages made."""
    folder = tmp_path_factory.mktemp("had")
    _meshes(folder)
    _photograph(folder)
    _foreign(folder)
    (text,) = (block for kind, block in steps(ROOT / "docs/sensors.md") if kind == "toml")
    for name in ("my.toml", "my-sensor.toml"):
        (folder / name).write_text(text)
    bins = read_sensor(folder / "my.toml").sensor.bins
    np.save(folder / "mine.npy", np.random.default_rng(0).normal(size=(8, bins)))
    with contextlib.chdir(folder):
        run("scene2spad render living-room")
        run("scene2spad sense living-room.exr --no-figure")
        run("scene2spad dataset rooms --out rooms --pack rooms.h5")
        run("scene2spad sense living-room.exr --export mat --out spad.h5 --no-figure")
    shutil.copy(folder / "living-room.exr", folder / "my.exr")
    shutil.copy(folder / "living-room.h5", folder / "my.h5")
    (folder / "spad.mat").rename(folder / "spad_0001_p1.mat")
    shutil.rmtree(folder / "rooms")
    return folder


class Cluster:
    """Commands `dask` of a page as processes of this machine, which end with the page."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{free.getsockname()[1]}"
        self.processes: list[subprocess.Popen] = []

    def here(self, line: str) -> str:
        return line.replace("HOST:8786", self.address).replace("--port 8786", f"--port {self.address[10:]}")

    def start(self, line: str) -> None:
        words = [sys.executable, "-m", *words_of(self.here(line)), "--no-dashboard"]
        self.processes.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def end(self) -> None:
        for process in reversed(self.processes):
            process.terminate()
            process.wait()


@pytest.fixture
def cluster():
    processes = Cluster()
    yield processes
    processes.end()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_says_runs(page, had, tmp_path, cluster, monkeypatch):
    provide_deepinv(monkeypatch)
    folder = shutil.copytree(had, tmp_path / "reader")
    done = 0
    with contextlib.chdir(folder):
        for kind, text in steps(page):
            if kind == "python":
                exec(compile(text, page.name, "exec"), {"__name__": "page"})
            elif text.startswith("dask "):
                cluster.start(text)
            elif kind == "command" and text.partition(" #")[0].strip() not in NOT_RUN:
                assert text.startswith("scene2spad "), f"{page.name}: neither run nor in NOT_RUN: {text}"
                run(cluster.here(text))
            done += kind != "toml"
    assert done


def test_what_is_not_run_is_on_a_page():
    said = {text.partition(" #")[0].strip() for page in PAGES for kind, text in steps(page) if kind == "command"}
    assert {*NOT_RUN} <= said, {*NOT_RUN} - said


def test_every_block_of_code_is_of_a_kind_that_is_run_or_read():
    """Indented lines are commands, output of a drawing, or parts of a sensor file; fences say what they hold."""
    for page in PAGES:
        kinds = {match[1] for match in map(FENCE.match, page.read_text(encoding="utf-8").splitlines()) if match}
        assert kinds <= {"", "python", "sh", "toml"}, page.name


def test_small_options_take_the_place_of_the_pages():
    assert shrunk(["render", "a", "--width", "64", "--offset", "7"]) == [
        "render", "a", "--offset", "7", "--width", "16", "--height", "12", "--bounces", "1",
    ]  # fmt: skip
    assert shrunk(["dataset", "rooms", "--count", "99", "--pack", "a"])[:4] == ["dataset", "rooms", "--pack", "a"]
