"""Sizes that nobody means are refused in one line before a set is listed, read, rendered or allocated."""

from __future__ import annotations

import importlib
import itertools
import sys
from contextlib import contextmanager

import pytest

from scene2spad.cli import main
from scene2spad.datasets import rendering as dataset
from scene2spad.datasets.rendering import Job, make_set
from scene2spad.datasets.workers import check_address
from scenes import InputError
from scenes.limits import VARIABLE

TRAIN = ["train", "--preset", "smoke"]
DATASET = ["dataset", "rooms"]


@pytest.mark.parametrize(
    ("argv", "why"),
    [
        ([*DATASET, "--count", "1000000000000"], "count 1000000000000 is outside 1 to 1000000"),
        ([*DATASET, "--width", "16384", "--height", "16384"], "views of 16384 x 16384 pixels on 1 process: needs 1"),
        ([*DATASET, "--width", "16384", "--workers", "4"], "on 4 processes: needs 6"),
        ([*DATASET, "--height", "20000"], "image side 20000 is outside 1 to 16384"),
        ([*DATASET, "--no-ambient", "--ambient-spp", "4"], "dataset: --ambient-spp 4 is for ambient light"),
        ([*DATASET, "--workers", "1000"], "workers 1000 is outside 1 to 256"),
        ([*TRAIN, "--batch", "100000000"], "a step of 100000000 patches of 8 x 8 pixels and 1024 bins: needs"),
        ([*TRAIN, "--crop", "1000000000"], "patches of 1000000000 x 1000000000 pixels"),
        ([*TRAIN, "--steps", "1000000000000"], "1000000000000 steps are above 100000000"),
        ([*TRAIN, "--threads", "1000000"], "threads 1000000 is outside 0 to 1024"),
        ([*TRAIN, "--init-share", "0.5"], "--init-share needs --init"),
        ([*TRAIN, "--set", "a.h5", "b.h5", "./a.h5"], "train: --set a.h5 is given twice; --set-weights says how often"),
        ([*TRAIN, "--validation", "a.h5", "x/../a.h5"], "train: --validation a.h5 is given twice"),
        ([*TRAIN, "--workers", "1000000"], "workers 1000000 is outside 0 to 256"),
    ],
)
def test_absurd_sizes_are_refused_before_any_work(tmp_path, capsys, monkeypatch, argv, why):
    def work(*_, **__):
        raise AssertionError("work was begun")

    monkeypatch.setenv(VARIABLE, "8")
    monkeypatch.setattr("scene2spad.networks.training.views_of", work)
    monkeypatch.setattr("scene2spad.datasets.rendering.SetFolder", work)
    assert main([*argv, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert why in message and message.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize("stage", ["render", "sense", "encode", "network", "emulate", "hard-cases"])
def test_a_bench_below_a_file_is_refused_before_it_measures(tmp_path, capsys, monkeypatch, stage):
    """It measured for minutes first, and then had no folder for its table."""
    (tmp_path / "notes.txt").write_text("mine")
    monkeypatch.setattr("importlib.import_module", lambda name, real=importlib.import_module: _no_bench(name, real))
    assert main(["bench", stage, "--out", str(tmp_path / "notes.txt" / "bench")]) == 2
    assert "notes.txt is a file, expected a folder" in capsys.readouterr().err


def _no_bench(name, real):
    assert not name.startswith("scene2spad.bench"), "work was begun"
    return real(name)


@pytest.mark.parametrize(
    "words",
    [["bench", "hard-cases", "--only"], ["bench", "--sizes", "--quick"], ["study", "tensors", "--checkpoints"]],
)
def test_a_list_without_a_value_is_refused(capsys, words):
    """Such as of an unset variable of the shell: all of them had been meant."""
    assert main(words) == 2
    assert "has no value; is a variable of the shell unset?" in capsys.readouterr().err


def test_a_run_that_has_no_place_is_refused_before_its_sets_are_read(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scene2spad.networks.training.views_of", None)
    (tmp_path / "notes.txt").write_text("mine")
    for place in (tmp_path, tmp_path / "notes.txt"):
        assert main([*TRAIN, "--out", str(place)]) == 2
        assert "is not an empty folder and holds no run" in capsys.readouterr().err


def test_a_set_of_a_million_views_is_listed_as_it_is_rendered(tmp_path, monkeypatch):
    """The first run is taken before the second is known; so are the views of an endless list."""
    first = next(dataset.views_by_place(Job("rooms"), itertools.count()))
    assert first == tuple(range(6))
    taken = []

    @contextmanager
    def executor(*_):
        def run(work, runs, lost):
            taken.append(next(runs))
            raise InputError("enough")

        yield run

    monkeypatch.setattr(dataset, "executor", executor)
    with pytest.raises(InputError, match="enough"):
        make_set(Job("rooms", width=8, height=8, bounces=1, grid=2), 1_000_000, tmp_path / "set")
    assert taken == [first]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("wall@2 --baseline 0.1 0 0 --offset 1", "a time offset needs a co-located laser"),
        ("wall@2 --baseline 0.1 0 0 --offset 1 --dry-run", "a time offset needs a co-located laser"),
        ("wall@2 --sunlight 100 --ambient off", "--sunlight 100 lux and --ambient off contradict each other"),
        ("wall@2 --ambient-spp 4 --ambient off", "--ambient-spp 4 and --ambient off contradict each other"),
        ("wall@2 --offset-mode ray", "--offset-mode ray is for a scene that is moved (--offset)"),
        ("wall@2 --sunlight 1e9", "--sunlight 1e+09 lux is outside 0 to 1e+06"),
    ],
)
def test_a_render_that_cannot_be_is_refused_before_it_begins(tmp_path, capsys, monkeypatch, words, why):
    def work(*_, **__):
        raise AssertionError("work was begun")

    monkeypatch.setattr("render.engine.render", work)
    monkeypatch.setattr("render.engine.planned", work)
    assert main(["render", *words.split(), "--out", str(tmp_path / "out.exr")]) == 2
    message = capsys.readouterr().err
    assert why in message and message.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("tensors --design nosuch", "design 'nosuch' is unknown"),
        ("tensors --design learned --block 0 4 4", "block (0, 4, 4): expected three positive whole numbers"),
        ("tensors --design learned --block 100000000 4 4", "100000000 bins are above the limit of 65536"),
        (
            "tensors --design fourier --codes 0",
            "0 codes over a block of 256 x 4 x 4, expected a whole number from 1 to",
        ),
        ("tensors --design fourier --codes 99999", "99999 codes over a block of 256 x 4 x 4, expected a whole number"),
        (
            "tensors --design fourier --block 300 4 4",
            "design 'fourier' over a block of 300 x 4 x 4 has no spatial part",
        ),
        ("tensors --block 300 4 4", "study tensors: --block 300 4 4 is for a --design"),
        ("tensors --checkpoints nosuch.npy", "nosuch.npy: file not found"),
        ("power --signal -1", "photon budget: signal -1 photons per pixel is outside 0 to 1e+09"),
        ("power --background nan", "photon budget: background nan photons"),
        ("power --width 6", "width 6: expected a multiple of 4"),
        ("all --signal -1", "photon budget: signal -1 photons per pixel is outside 0 to 1e+09"),
        ("codes --height 1000000", "study codes: --height 1000000 is outside 1 to 16384 pixels"),
        ("codes --scene castle", "scene 'castle': expected one of"),
        ("codes --scene castle.obj", "castle.obj: file not found"),
        ("render-error --views 0", "views 0 is outside 1 to"),
        ("render-error --cache file.txt", "file.txt: is a file, expected a folder for the renders"),
        ("real-data --capture nosuch.mat", "nosuch.mat: file not found"),
        ("real-data --frame 3", "study real-data: --frame 3 is for captures in files (--capture)"),
        ("chip --models nosuch", "nosuch: folder of models not found (--models)"),
        ("chip --models file.txt", "file.txt: is a file, expected a folder of models (--models)"),
        ("chip --retrain --models file.txt", "file.txt: is a file, expected a folder for the models"),
        ("chip --retrain --set nosuch.h5", "nosuch.h5: file not found (--set)"),
        ("chip --retrain --set file.txt", "file.txt: is no pack of scene2spad (--set)"),
        ("depth-offset --retrain --set .", ".: no set of scene2spad, it has no index.jsonl (--set)"),
        ("chip --set nosuch.h5", "--set nosuch.h5 is for models that are trained (--retrain or --preset smoke)"),
        ("transport --preset smoke --set nosuch.h5", "--set nosuch.h5 is for models that are trained"),
        ("power --preset smoke --models nosuch", "nosuch: folder of models not found (--models)"),
        ("tensors --retrain", "study tensors: --retrain is for study chip, depth-offset"),
        ("memory --models nosuch", "study memory: --models nosuch is for study chip, depth-offset"),
        ("power --set nosuch.h5", "study power: --set nosuch.h5 is for study chip, depth-offset"),
        ("codes --preset paper", "study codes: --preset paper is for study power, chip, depth-offset"),
    ],
)
@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
def test_a_study_that_cannot_be_is_refused_before_it_is_loaded(tmp_path, capsys, monkeypatch, words, why, dry):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.txt").write_text("mine")
    monkeypatch.setattr("scene2spad.studies.every.run_one", None)
    monkeypatch.setattr("scene2spad.dry_runs.studies.dry_run", None)
    assert main(["study", *words.split(), *dry]) == 2
    message = capsys.readouterr().err
    assert why in message and message.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("demo --signal nan", "photon budget: signal nan photons per pixel is outside 0 to 1e+09"),
        ("demo --width 0", "demo: --width 0 is outside 1 to 16384 pixels"),
        ("demo --height 1000000", "demo: --height 1000000 is outside 1 to 16384 pixels"),
        ("demo --scene castle", "scene 'castle': expected one of"),
        ("demo --out file.txt", "file.txt: is a file, expected a folder for the demo's results"),
        ("render plane --height 1000000", "render: --height 1000000 is outside 1 to 16384 pixels"),
        ("ultraphase compile learned-256x2x2-128x-s0 --headroom 5", "compile: --headroom 5 is outside 0 to 4"),
        ("ultraphase compile learned-256x2x2-128x-s0 --headroom -1", "compile: --headroom -1 is outside 0 to 4"),
        ("ultraphase compile gate.s", "gate.s: is a program's source, which `ultraphase list` shows"),
        ("ultraphase compile nosuch.ckpt", "nosuch.ckpt: file not found"),
        ("ultraphase compile file.txt", "file.txt: is no trained model, expected a name of `scene2spad models`"),
        ("evaluate none-s0 --set cut.h5", "cut.h5: is no HDF5 file of ours"),
        ("evaluate none-s0 --set nosuch.h5", "nosuch.h5: file not found"),
        ("evaluate nosuch.ckpt --set cut.h5", "nosuch.ckpt: file not found"),
        ("evaluate --set cut.h5 --baselines argmax none-s0", "evaluate: no checkpoint; MODEL [MODEL ...] comes before"),
        ("models import file.txt --out file.txt", "file.txt: is a file, expected a folder for the model"),
        ("models import file.txt --out file.txt/m", "file.txt is a file, expected a folder"),
        ("models import file.txt --out run", "run/model.safetensors: exists; choose another folder"),
        ("models import nosuch.ckpt", "nosuch.ckpt: checkpoint not found"),
    ],
)
def test_plain_mistakes_are_refused_before_anything_heavy_is_loaded(tmp_path, capsys, monkeypatch, words, why):
    """Neither a model nor a renderer is called: nor can their modules be imported."""
    monkeypatch.chdir(tmp_path)
    for name in ("file.txt", "cut.h5", "gate.s", "run/model.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    before = {*tmp_path.rglob("*")}
    for module in ("render.engine", "csph.networks.model", "csph.weights.cards", "csph.weights.published"):
        monkeypatch.setitem(sys.modules, module, None)
    assert main(words.split()) == 2
    message = capsys.readouterr().err
    assert why in message and message.count("\n") == 1
    assert {*tmp_path.rglob("*")} == before


def test_help_says_that_a_checkpoint_is_needed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["evaluate", "--help"]) == 0
    shown = capsys.readouterr()
    first = (shown.out + shown.err).splitlines()[0]
    assert first.endswith("MODEL [MODEL ...]") and "[[" not in first
    assert "compared with. (required)" in " ".join((shown.out + shown.err).replace("│", " ").split())


def test_a_sheet_of_an_endless_set_has_a_limit(tmp_path, capsys):
    assert main(["scenes", "rooms", "--sheet", str(tmp_path / "s.png"), "--count", "1000000000000"]) == 2
    assert capsys.readouterr().err == "scene2spad: --count 1000000000000 is more than 1000 views\n"


@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
@pytest.mark.parametrize("address", ["nowhere", "tcp://host", "tcp://host:0", "tcp://host:99999", "host:8786:1"])
def test_what_is_no_address_is_refused_before_the_set_is_looked_at(tmp_path, capsys, monkeypatch, address, dry):
    monkeypatch.setattr("scene2spad.datasets.rendering.SetFolder", None)
    assert main([*DATASET, "--scheduler", address, "--out", str(tmp_path / "set"), *dry]) == 2
    message = capsys.readouterr().err
    assert f"scheduler {address}: is no address, expected tcp://HOST:PORT" in message and message.count("\n") == 1


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:8786", "tls://node-3.cluster:1", "node3:65535", "tcp://[::1]:8786"]
)
def test_addresses_are_addresses(address):
    check_address(address)


@pytest.mark.parametrize(
    "words",
    ["scenes --sheet a.txt/x.png", "render plane --out a.txt/x.exr", "dataset rooms --pack a.txt/p.h5 --out set"]
    + ["ultraphase list fourier-8 --out a.txt/x.txt", "dataset rooms --pack a.txt/deep/p.h5 --out set"],
)
def test_a_file_where_a_folder_should_be_is_called_a_file(tmp_path, capsys, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_text("mine")
    assert main(words.split()) == 2
    message = capsys.readouterr().err
    assert message.endswith(": a.txt is a file, expected a folder\n") and message.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
