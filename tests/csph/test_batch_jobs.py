"""A training within a batch system's job, and under its signals: the job's tasks and SIGTERM are not Lightning's."""

import os
import signal
import sys
from collections.abc import Iterator

import pytest
from processes import run_process
from test_training import FEW, MODEL, near_planes

from csph.networks.checkpoint import load_model, weights_sha256
from csph.networks.config import preset
from csph.training.loop import DepthTraining, train
from csph.training.views import split_views

IGNORING = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a script's background begins
signal.signal(signal.SIGTERM, signal.SIG_DFL)
from scene2spad.networks import training
import csph.training.loop as loop
asked = loop.train
def train(*sets, progress, **more):
    def stopping(what, fraction):
        if what.startswith("step 3"):
            os.kill(os.getpid(), signal.SIGTERM)
    return asked(*sets, progress=stopping, **more)
loop.train = train
from scene2spad.start import script
sys.argv[1:] = "train --set planes --preset smoke --threads 1 --out run".split()
script()
"""


@pytest.fixture
def restored() -> Iterator[None]:
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("tasks", ["SLURM_NTASKS", "SLURM_NTASKS_PER_NODE"])
def test_a_job_of_several_tasks_trains_as_a_process_alone(tasks, tmp_path, monkeypatch):
    """`--ntasks=4` was a traceback of Lightning's, which took the job for a training on four devices."""
    config, sets = preset("smoke", MODEL, **FEW), split_views(near_planes(3))
    train(config, *sets, tmp_path / "alone")
    job = {"SLURM_NTASKS": "4", tasks: "4", "SLURM_JOB_NAME": "job", "SLURM_JOB_ID": "7", "SLURM_PROCID": "2"}
    for name, value in job.items():
        monkeypatch.setenv(name, value)
    train(config, *sets, tmp_path / "task")
    alone, task = (weights_sha256(load_model(tmp_path / name)[0]) for name in ("alone", "task"))
    assert alone == task


@pytest.mark.parametrize("ignored", [True, False])
def test_a_training_goes_on_where_sigterm_is_ignored_or_has_a_handler_that_returns(ignored, tmp_path, restored):
    """It ended at the next step, as by Ctrl-C."""
    heard = []
    signal.signal(signal.SIGTERM, signal.SIG_IGN if ignored else lambda number, frame: heard.append(number))

    def progress(what: str, fraction: float) -> None:
        if what.startswith("step 3 "):
            os.kill(os.getpid(), signal.SIGTERM)

    found = train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path, progress=progress)
    assert (found["steps"], len(heard)) == (9, not ignored)


def test_ctrl_c_before_the_first_step_leaves_the_next_ctrl_c_alone(tmp_path, monkeypatch):
    """Lightning ignores it while it shuts down, and for good where it had not begun its loop."""

    def interrupted(self: DepthTraining) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DepthTraining, "configure_optimizers", interrupted)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(KeyboardInterrupt):
            train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path)
        assert signal.getsignal(signal.SIGINT) == before
    finally:
        signal.signal(signal.SIGINT, before)


def test_sigterm_ends_a_training_by_itself_where_ctrl_c_is_ignored(tmp_path):
    """The status was 130, which is Ctrl-C's; a shell makes 143 of the signal."""
    done = run_process([sys.executable, "-c", IGNORING], cwd=tmp_path)
    assert done.returncode == -signal.SIGTERM, done.stderr
