"""Files of one's own codes as `evaluate`, `compare` and `depth` take them: by one parser, with the same answers."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from render.transient import write_transient
from render.transient.packs import write_pack
from scene2spad import coding_tensor, estimate_depth, sense
from scene2spad.cli import main
from scene2spad.datasets.planes import wall


@pytest.fixture(autouse=True)
def codes(tmp_path, monkeypatch):
    """Codes with the answers of fourier-8, and such as tell less than they are, beside a set of two walls."""
    monkeypatch.chdir(tmp_path)
    fourier = coding_tensor("fourier", 8).temporal.numpy()
    np.save("mine.npy", fourier)
    np.save("twice.npy", np.concatenate([fourier, fourier[:2]]))
    np.save("same.npy", fourier[:1].repeat(16, 0))
    np.save("short.npy", fourier[:, :64])
    Path("mine.npy").rename("MINE.NPY")
    write_pack([(wall(distance, 4), {"scene": f"walls/{distance:g}"}) for distance in (2.0, 3.0)], Path("walls.h5"))
    Path("views").mkdir()
    for distance in (2.0, 3.0):
        write_transient(wall(distance, 4), Path(f"views/wall-{distance:g}.exr"))


def test_evaluate_takes_them_as_baselines(capfd):
    assert main(["export", "fourier-1024x1x1-128x-s0", "--out", "mine.txt"]) == 0
    evaluate = ["evaluate", "none-s0", "--set", "walls.h5", "--levels", "50+1", "--out", "out", "--baselines"]
    assert main([*evaluate, "fourier-8", "MINE.NPY", "mine.txt"]) == 0
    assert "rank" not in capfd.readouterr().err
    with Path("out/evaluation.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["group"] == "all"]
    errors = {name: [row["mae_mm"] for row in rows if row["method"] == name] for name in ("fourier-8", "MINE.NPY")}
    assert errors["fourier-8"] == errors["MINE.NPY"] and len(errors["MINE.NPY"]) == 2
    assert sum(row["method"] == "mine.txt" for row in rows) == 2


def test_random_codes_are_those_of_the_seed_in_every_command(capfd):
    """`evaluate` had those of seed 0, under the same name as other codes of `compare`."""
    np.save("drawn.npy", coding_tensor("random", 8, seed=5).temporal.numpy())
    names = ["random-8", "drawn.npy"]
    evaluate = ["evaluate", "none-s0", "--set", "walls.h5", "--levels", "50+1", "--out", "out", "--seed", "5", "--json"]
    assert main([*evaluate, "--baselines", *names]) == 0
    errors = json.loads(capfd.readouterr().out)["methods"]
    assert main(["sense", "views/wall-2.exr", "--no-figure"]) == 0
    capfd.readouterr()
    assert main(["compare", "views/wall-2.h5", "--methods", *names, "--seed", "5", "--json"]) == 0
    compared = json.loads(capfd.readouterr().out)["methods"]
    first, second = ({key: row[key] for key in ("mae_mm", "rmse_mm")} for row in compared)
    assert first == second and errors[names[0]]["all"]["all"] == errors[names[1]]["all"]["all"]


def test_names_are_those_of_one_parser(capfd):
    histogram = sense(wall(2.0, 4), signal=50, background=1)
    np.save("drawn.npy", coding_tensor("fourier", 8).temporal.numpy())
    assert np.array_equal(estimate_depth(histogram, "fourier-8"), estimate_depth(histogram, Path("drawn.npy")))
    for name in ("none-s0", "fourier-x", "nosuch-8"):
        assert main(["evaluate", "none-s0", "--set", "walls.h5", "--out", "out", "--baselines", name]) == 2
        message = capfd.readouterr().err
        assert f"method '{name}' is none of argmax, " in message and message.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none.npy", r"none\.npy: (array )?file not found"),
        ("none.txt", r"none\.txt: (table of codes|file) not found"),
        ("short.npy", "short.npy: codes of blocks of 64 bins x 1 rows x 1 columns, expected those of one pixel"),
        ("same.npy", "same.npy: coding tensor same: its 16 codes have rank 1 where a uniform background is removed"),
    ],
)
def test_what_cannot_be_decoded_is_refused_alike(name, words, capfd):
    assert main(["sense", "views/wall-2.exr", "--no-figure"]) == 0
    for command in (
        ["evaluate", "none-s0", "--set", "walls.h5", "--out", "out", "--baselines", name],
        ["compare", "views/wall-2.h5", "--methods", name],
        ["depth", "views/wall-2.h5", "--method", "compressive", "--codes-file", name],
    ):
        capfd.readouterr()
        assert main(command) == 2
        message = capfd.readouterr().err
        assert re.search(words, message) and message.count("\n") == 1


def test_codes_that_depend_on_each_other_are_told_once(capfd):
    argv = ["depth", "views", "--method", "compressive", "--codes-file", "twice.npy", "--no-figure", "--json"]
    assert main(argv) == 0
    told = capfd.readouterr()
    assert json.loads(told.out)["views"] == 2
    assert told.err.count("twice.npy: its 10 codes have rank 8 where a uniform background is removed") == 1
