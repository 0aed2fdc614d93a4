"""Sets of views: the same bytes however they are made, killed, resumed or shared out; failures recorded."""

import json
import logging
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from processes import end_at_three, ended_process
from set_folders import begun

from render.transient import read_transient
from render.transient.packs import PATH_STEP_M, read_pack
from scene2spad.cli import main
from scene2spad.datasets import processes
from scene2spad.datasets import rendering as dataset
from scene2spad.datasets.packing import pack_set
from scene2spad.datasets.rendering import Job, make_set, render_view
from scene2spad.datasets.workers import executor
from scenes import InputError
from scenes.io.set_index import read_set_index

# hard cases 0 to 7: walls at 0.05 to 500 m, quick to build and to render
JOB = Job("hard-cases", width=12, height=9, bounces=1, grid=2)
COUNT = 8
ARGUMENTS = ["dataset", "hard-cases", "--width=12", "--height=9", "--bounces=1", "--grid=2", "--error=0.01"]
CLI_JOB = Job("hard-cases", 0, 12, 9, 1, None, 2, 0.01)
ONE_WORKER = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "protocol": "tcp", "host": "127.0.0.1"}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a set but for the times."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "timings.jsonl")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The set made in one go."""
    out = tmp_path_factory.mktemp("whole") / "set"
    make_set(CLI_JOB, COUNT, out)
    return out


def test_a_set_has_its_files_and_an_index_in_order(whole):
    names = {f"views/{i:06d}.exr" for i in range(COUNT)}
    assert set(contents(whole)) == names | {"set.json", "index.jsonl"}
    records = read_set_index(whole)
    assert [r["view"] for r in records] == list(range(COUNT))
    for record in records:
        transient = read_transient(whole / record["file"])
        assert transient.meta["scene"] == record["scene"] and transient.meta["seed"] == record["seed"]
        assert record["depth_m"]["median"] == pytest.approx(np.nanmedian(transient.depth_m), abs=1e-3)
        assert record["returns"] == transient.returns and record["bytes"] == (whole / record["file"]).stat().st_size
    timings = [json.loads(line) for line in (whole / "timings.jsonl").read_text().splitlines()]
    assert sorted(t["view"] for t in timings) == list(range(COUNT)) and all(t["seconds"] > 0 for t in timings)


def test_a_run_stopped_anywhere_and_resumed_gives_the_same_bytes(whole, tmp_path):
    """Stopped after some views, with a cut line in the journal, a stray half file and a missing one."""
    out = tmp_path / "set"
    folder = begun(out, CLI_JOB.made())
    for view in (5, 0, 3):
        folder.add(render_view(CLI_JOB, view))
    with (out / "journal.jsonl").open("a") as file:
        file.write('{"view": 7, "file": "vie')
    half = f".000006.{os.uname().nodename[:40]}.{ended_process()}.part.exr"
    (out / "views" / half).write_bytes(b"half")
    (out / "views" / "000003.exr").write_bytes(b"cut")
    result = make_set(CLI_JOB, COUNT, out)
    assert result["rendered_now"] == COUNT - 2 and result["failed"] == []
    assert contents(out) == contents(whole)


def test_more_views_are_added_to_a_set_that_is_there(whole, tmp_path):
    out = tmp_path / "set"
    make_set(CLI_JOB, 3, out)
    assert make_set(CLI_JOB, COUNT, out)["rendered_now"] == COUNT - 3
    assert contents(out) == contents(whole)
    assert make_set(CLI_JOB, 2, out)["rendered_now"] == 0


def test_other_options_need_another_folder(whole, tmp_path):
    with pytest.raises(InputError, match="other options"):
        make_set(JOB, 1, whole)
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        make_set(JOB, 1, tmp_path)


def test_a_view_that_fails_is_recorded_skipped_and_tried_again(tmp_path, monkeypatch):
    real = dataset.record_and_exr

    def odd(job, view, again):
        if view == 1:
            raise ValueError("an odd\nscene")
        return real(job, view, again)

    monkeypatch.setattr(dataset, "record_and_exr", odd)
    result = make_set(JOB, 3, tmp_path / "set")
    assert result["failed"] == [1] and result["scenes"] == 2
    lines = [json.loads(line) for line in (tmp_path / "set" / "index.jsonl").read_text().splitlines()]
    assert lines[1] == {"failed": "ValueError: an odd scene", "view": 1}
    monkeypatch.setattr(dataset, "record_and_exr", real)
    again = make_set(JOB, 3, tmp_path / "set")
    assert again["rendered_now"] == 1 and again["failed"] == [] and again["scenes"] == 3


def test_nothing_in_view_is_a_failure_of_that_view_alone(tmp_path):
    from scenes.library.hard_cases import SCENES

    view = list(SCENES).index("nothing")
    done = render_view(JOB, view)
    assert done.exr is None and "nothing in view" in done.record["failed"]


@pytest.mark.parametrize("filtered", [False, True])
def test_a_view_does_not_depend_on_what_was_rendered_before_it(filtered):
    """The cameras of a room share one traced world: in any order, and alone, they give the same bytes."""
    job = Job("rooms", width=16, height=16, error=0.2, filter=filtered)
    in_order = [render_view(job, view).exr for view in (0, 1, 2, 4)]
    assert all(in_order)
    assert [render_view(job, view).exr for view in (4, 2, 1, 0)] == in_order[::-1]
    dataset.forget_places()
    assert render_view(job, 1).exr == in_order[1]


def test_an_endless_set_has_one_grid_however_many_views_are_asked(tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.datasets.rendering.PLANNED_PLACES", 2)
    job = Job("rooms", width=16, height=16, bounces=1, error=0.05)
    for count in (1, 5):
        make_set(job, count, tmp_path / "in steps")
    make_set(job, 5, tmp_path / "at once")
    steps, once = (tmp_path / name for name in ("in steps", "at once"))
    for name in ("grid.json", "index.jsonl", "views/000000.exr", "views/000004.exr"):
        assert (steps / name).read_bytes() == (once / name).read_bytes()
    planned = json.loads((once / "grid.json").read_text())
    assert len(planned["errors"]) == 6 and {r["plan"]["grid"] for r in read_set_index(once)} == {planned["grid"]}
    make_set(replace(job, grid=3), 1, tmp_path / "forced")
    assert not (tmp_path / "forced" / "grid.json").exists()
    (once / "grid.json").write_text("{")
    with pytest.raises(InputError, match=r"grid\.json: is damaged"):
        make_set(job, 6, once)


def test_places_that_cannot_be_planned_are_left_out_of_the_plan(tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.datasets.rendering.PLANNED_PLACES", 2)
    monkeypatch.setattr("scene2spad.datasets.rendering.OF_A_PLACE", 1)
    job, errors = Job("rooms", width=8, height=8, bounces=1), iter((ValueError("odd"), 0.02))

    def direct_error(*_):
        error = next(errors)
        if isinstance(error, Exception):
            raise error
        return error

    monkeypatch.setattr("render.set_planning.direct_error", direct_error)
    result = make_set(job, 1, tmp_path)
    planned = json.loads((tmp_path / "grid.json").read_text())
    assert result["scenes"] == 1 and planned["errors"] == [0.02]
    assert planned["grid"] == 4 and planned["edge_threshold"] < 0.5


def test_a_view_is_the_same_where_files_have_names(tmp_path, monkeypatch):
    """Linux keeps a view in a file without a name: TMPDIR is not used, and a kill leaves nothing. Others use it."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    exr = render_view(JOB, 0).exr
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.delattr(os, "memfd_create")
    assert render_view(JOB, 0).exr == exr and not [*tmp_path.iterdir()]


def test_cameras_of_a_place_share_the_plan_of_its_first():
    job = Job("rooms", width=16, height=16, bounces=1, error=0.02)
    assert len({render_view(job, view).record["plan"]["grid"] for view in (2, 1, 0)}) == 1


def test_two_processes_give_the_same_bytes(whole, tmp_path):
    make_set(CLI_JOB, COUNT, tmp_path / "set", workers=2)
    assert contents(tmp_path / "set") == contents(whole)


def test_the_command_line_packs(whole, tmp_path, capsys):
    out, pack = tmp_path / "set", tmp_path / "set.h5"
    make_set(CLI_JOB, 3, out)
    assert main([*ARGUMENTS, "--count", "3", "--out", str(out), "--pack", str(pack), "--json"]) == 0
    message = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (
        message["scenes"] == 3
        and message["failed"] == []
        and message["bytes_per_scene"] > 0
        and "scenes_per_second" in message
    )
    views = read_pack(pack)
    for i, record in enumerate(read_set_index(out)):
        transient = read_transient(out / record["file"])
        assert views.metas[i]["scene"] == record["scene"] and (views[i].offsets == transient.offsets).all()
        centre, expected = ((v.path_near_m.astype(float) + v.path_far_m) / 2 for v in (views[i], transient))
        assert centre == pytest.approx(expected, abs=0.51 * PATH_STEP_M)
    again = tmp_path / "again.h5"
    assert pack_set(out, again) == len(read_set_index(out)) and again.stat().st_size == pack.stat().st_size


def test_views_above_their_error_target_are_one_line_on_the_screen(tmp_path, capsys):
    argv = ["dataset", "hard-cases", "--width", "12", "--height", "9", "--bounces", "1", "--grid", "2"]
    assert main([*argv, "--error", "1e-4", "--count", "3", "--out", str(tmp_path / "set")]) == 0
    message = capsys.readouterr().err
    assert "views end above their error target" in message and message.count("\n") == 1


def test_views_above_their_error_target_are_counted(tmp_path, caplog, monkeypatch):
    """Two rays a side do not meet 1e-4: every view says so in the index, the set in its result and in one warning."""
    job = replace(CLI_JOB, error=1e-4)
    monkeypatch.setattr(logging.getLogger("scene2spad"), "propagate", True)  # the command line stops it there
    with caplog.at_level(logging.WARNING, logger="scene2spad"):
        result = make_set(job, 3, tmp_path / "set")
    records = read_set_index(tmp_path / "set")
    assert [record["target_met"] for record in records] == [record["error"] <= 1e-4 for record in records]
    missed = sum(not record["target_met"] for record in records)
    assert result["target_missed"] == missed > 0
    assert result["error_together"] == pytest.approx(np.sqrt(np.mean([record["error"] ** 2 for record in records])))
    message, worst = caplog.records[-1].getMessage(), max(record["error"] for record in records)
    assert message.startswith(f"warning: {missed} of 3 views end above their error target of 0.0001, the worst, view ")
    assert f", at {worst:.4g}; " in message and ", within 0.0001, which is what a set is planned for" in message
    make_set(replace(CLI_JOB, error=1e-4, grid=1), 3, tmp_path / "missed")
    assert ", above 0.0001, which is what a set is planned for" in caplog.records[-1].getMessage()
    assert read_transient(tmp_path / "set" / records[0]["file"]).meta["target_met"] == records[0]["target_met"]
    assert make_set(replace(CLI_JOB, error=1.0), 3, tmp_path / "easy")["target_missed"] == 0


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--count", "0"], "count 0"),
        (["--count", "999"], "count 999"),
        (["--workers", "0"], "workers 0"),
        (["--offset", "-1"], "offset"),
        (["--bounces", "0"], "bounces"),
        (["--pack", "set.txt"], "must end in .h5"),
    ],
)
def test_bad_options_are_one_line(tmp_path, capsys, options, why):
    assert main([*ARGUMENTS, "--out", str(tmp_path / "set"), *options]) == 2
    message = capsys.readouterr().err
    assert why in message and message.count("\n") == 1
    assert main(["dataset", "kitchens"]) == 2 and "expected one of rooms/train" in capsys.readouterr().err


def start(out: Path, *more: str) -> subprocess.Popen:
    program = "import sys; from scene2spad.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, *ARGUMENTS, "--count", str(COUNT), "--out", str(out), *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def views_in(out: Path) -> int:
    return len(list((out / "views").glob("0*.exr"))) if (out / "views").is_dir() else 0


def kill_and_resume(out: Path, moment: random.Random, workers: str, times: int) -> None:
    """SIGKILL to the process and its workers at random moments after the start of the work, then a run to the end."""
    for _ in range(times):
        process = start(out, "--workers", workers)
        begun = views_in(out)
        while process.poll() is None and views_in(out) == begun < COUNT:
            time.sleep(0.01)
        time.sleep(moment.uniform(0, 0.5))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for path in out.glob("views/0*.exr"):
            read_transient(path)
    assert start(out, "--workers", workers).wait() == 0


def test_a_killed_run_goes_on_where_it_was(whole, tmp_path):
    kill_and_resume(tmp_path / "set", random.Random(1), "1", 1)
    assert contents(tmp_path / "set") == contents(whole)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_ten_kills_with_one_and_two_processes(whole, tmp_path, seed):
    kill_and_resume(tmp_path / "one", random.Random(seed), "1", 1)
    kill_and_resume(tmp_path / "two", random.Random(100 + seed), "2", 1)
    assert contents(tmp_path / "one") == contents(whole) == contents(tmp_path / "two")


def test_a_dead_worker_process_loses_nothing(whole, tmp_path):
    """A worker of the pool is killed while it renders: others take over."""
    out = tmp_path / "set"
    process = start(out, "--workers", "2")
    while process.poll() is None and views_in(out) < 2:
        time.sleep(0.02)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    if workers:
        os.kill(int(workers[0]), signal.SIGKILL)
    assert process.wait() == 0 and contents(out) == contents(whole)


def test_only_what_ends_its_process_by_itself_is_lost(monkeypatch):
    """Others that were under way when number 3 ended the processes, three times and more, are done."""
    monkeypatch.setattr(processes, "start_worker", max)  # a worker of no renderer
    with executor(3, None) as run:
        found = list(run(end_at_three, [(number,) for number in range(8)], lambda number, why: (number, why)))
    lost = [one for one in found if isinstance(one, tuple)]
    assert lost == [(3, "its process died 4 times, at last by itself")]
    assert sorted(one for one in found if one not in lost) == [0, 1, 2, 4, 5, 6, 7]


@pytest.mark.slow
@pytest.mark.parametrize("kill", [False, True])
def test_a_dask_cluster_gives_the_same_bytes_and_survives_a_dead_worker(whole, tmp_path, kill):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        victims = [worker.pid for worker in cluster.workers.values()]
        killed = []

        def progress(what: str, fraction: float) -> None:
            if kill and fraction > 0.3 and not killed:
                killed.append(victims[0])
                os.kill(victims[0], signal.SIGKILL)

        make_set(CLI_JOB, COUNT, tmp_path / "set", scheduler=cluster.scheduler_address, progress=progress)
    assert bool(killed) == kill and contents(tmp_path / "set") == contents(whole)


def test_a_result_that_dies_with_its_worker_before_it_is_fetched_is_made_again(monkeypatch):
    """A finished run whose result cannot be fetched goes on number by number; a number by itself is told."""
    distributed = pytest.importorskip("distributed")
    result, lost = distributed.Future.result, []

    def dead_result(future, *arguments, **options):
        numbers = result(future, *arguments, **options)
        if numbers in ([0, 1], [1], [2]):
            raise distributed.KilledWorker(future.key, SimpleNamespace(address="tcp://dead"), 3)
        return numbers

    with distributed.LocalCluster(**ONE_WORKER, dashboard_address=None) as cluster:
        monkeypatch.setattr(distributed.Future, "result", dead_result)
        with executor(1, cluster.scheduler_address) as run:
            found = list(run(list, [(0, 1), (2,), (3, 4)], lambda number, why: lost.append(why) or -number))
    assert sorted(found) == [-2, -1, 0, 3, 4]
    assert len(lost) == 2 and all(why.startswith("its workers died: Attempted to run") for why in lost)


def test_a_connection_that_closes_under_a_fetch_is_the_scheduler_gone_away(monkeypatch):
    """A fetch may notice first, while the client's status is still `running`: one line that names the scheduler."""
    distributed = pytest.importorskip("distributed")
    from distributed.comm import CommClosedError

    def closed(future, *arguments, **options):
        raise CommClosedError("in <TCP (closed) ConnectionPool.gather>: Stream is closed")

    with distributed.LocalCluster(**ONE_WORKER, dashboard_address=None) as cluster:
        monkeypatch.setattr(distributed.Future, "result", closed)
        with (
            pytest.raises(InputError, match=r"^scheduler tcp://\S+: has gone away; what is finished stays"),
            executor(1, cluster.scheduler_address) as run,
        ):
            list(run(list, [(0,)], lambda number, why: -number))
