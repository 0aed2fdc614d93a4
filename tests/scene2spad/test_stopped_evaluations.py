"""An evaluation that is stopped goes on: the same table, and no estimate of a network is made twice."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csph.networks.model import DepthModel
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import wall
from scene2spad.networks import published
from scene2spad.networks.evaluating import run_evaluate
from scene2spad.options.networks import Evaluate

COMMAND = Evaluate(
    checkpoints=(Path("learned-256x4x4-128x-s0"), Path("fourier-1024x1x1-128x-s0")),
    set=Path("walls.h5"),
    baselines=("argmax", "random-8"),
    levels=("50+1", "1+1"),
    int8=True,
    maps=True,
    out=Path("whole"),
)
OF_NETWORKS = 2 * 2 * 4  # views, levels, networks and their codes in 8 bits


class Stopped(Exception):
    pass


@pytest.fixture
def estimates(tmp_path, monkeypatch) -> list[int]:
    """Two views in a folder of their own; counts what networks estimate."""
    monkeypatch.chdir(tmp_path)
    write_pack([(wall(distance, 8), {"scene": f"walls/{distance:g}"}) for distance in (2.0, 3.0)], Path("walls.h5"))
    made, estimate = [], DepthModel.estimate

    def counted(self, *given, **options):
        found = estimate(self, *given, **options)
        made.append(1)
        return found

    monkeypatch.setattr(DepthModel, "estimate", counted)
    return made


def ignored(what: str, fraction: float | None) -> None:
    pass


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stop_at(command: Evaluate, exposure: int) -> None:
    """Run a command up to the end of so many exposures."""
    begun = []

    def progress(what: str, fraction: float | None) -> None:
        begun.append(what)
        if len(begun) > exposure:
            raise Stopped

    with pytest.raises(Stopped):
        run_evaluate(command, progress)


def test_a_stopped_evaluation_goes_on_with_the_same_table(estimates, caplog):
    whole = run_evaluate(COMMAND, ignored)
    assert len(estimates) == OF_NETWORKS and len(files(Path("whole"))) == 2 + 2 * 2 * 6
    stopped = replace(COMMAND, out=Path("stopped"))
    for exposure in (0, 1, 3):  # the third time goes on from the second
        stop_at(stopped, exposure)
        assert not Path("stopped/maps").exists() and not Path("stopped/evaluation.csv").exists()
    caplog.set_level("INFO")
    found = run_evaluate(stopped, ignored)
    assert len(estimates) == 2 * OF_NETWORKS and "12 depth maps of networks are those of" in caplog.text
    assert files(Path("stopped")) == files(Path("whole"))
    assert {**found, "csv": "", "maps": ""} == {**whole, "csv": "", "maps": ""}


def test_one_on_the_published_pairs_goes_on_with_the_same_table(estimates, monkeypatch):
    """Two pairs at two levels, by both decoders; the first run stops before its fourth exposure."""
    rng = np.random.default_rng(5)
    made_up = [published.Pair(f"made-up {n}", *(0.2 + rng.random((2, 16, 16)))) for n in range(2)]
    monkeypatch.setattr(published, "pairs", lambda count=None: made_up)
    monkeypatch.setattr(published, "PHOTON_LEVELS", ((50.0, 50.0), (10.0, 50.0)))
    command = replace(COMMAND, set=Path("published"), baselines=(), levels=(), int8=False, maps=False)
    whole = published.run_evaluate(command, ignored)
    an_exposure = 2 * 2  # networks and decoders
    assert len(estimates) == 4 * an_exposure
    stopped, begun = replace(command, out=Path("stopped")), []

    def progress(what: str, fraction: float | None) -> None:
        begun.append(what)
        if len(begun) > 3:
            raise Stopped

    with pytest.raises(Stopped):
        published.run_evaluate(stopped, progress)
    assert len(estimates) == 7 * an_exposure and not Path("stopped/evaluation-published.csv").exists()
    assert {**published.run_evaluate(stopped, ignored), "csv": ""} == {**whole, "csv": ""}
    assert len(estimates) == 8 * an_exposure and files(Path("stopped")) == files(Path("whole"))


def test_what_other_options_left_does_no_harm(estimates):
    """Other levels, another decoder and seed, and the maps of more methods: none of them comes into the table."""
    stop_at(replace(COMMAND, decoder="soft-argmax", out=Path("out")), 2)
    stop_at(replace(COMMAND, seed=1, offset=1.0, out=Path("out")), 2)
    asked = replace(COMMAND, baselines=(), levels=("50+1",), int8=False)
    run_evaluate(replace(asked, out=Path("out")), ignored)
    run_evaluate(replace(asked, out=Path("other")), ignored)
    assert files(Path("out")) == files(Path("other"))


def test_a_place_that_cannot_be_used_is_refused_before_the_first_estimate(estimates, capfd):
    Path("out").mkdir()
    Path("out/unfinished").write_text("mine")
    assert main(["evaluate", "none-s0", "--set", "walls.h5", "--out", "out"]) == 2 and not estimates
    assert "out/unfinished" in capfd.readouterr().err


def test_maps_go_where_a_link_leads(estimates):
    Path("far").mkdir()
    Path("out").mkdir()
    Path("out/maps").symlink_to("../far")
    run_evaluate(replace(COMMAND, levels=("50+1",), int8=False, out=Path("out")), ignored)
    assert Path("out/maps").is_symlink() and len([*Path("far").rglob("*.exr")]) == 2 * 4
