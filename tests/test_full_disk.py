"""A disk that is full in the middle of a run: one line that names the file, and with space the run goes on.

The disk is a small file system in memory, mounted in a name space of the test's own.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator

import pytest
from killed import Run, Warm, command, contents, whole_run

UNSHARE = ("unshare", "--user", "--map-root-user", "--mount")
SET = ("dataset", "hard-cases", "--width", "12", "--height", "9", "--bounces", "1", "--grid", "2", "--count", "8")
# Runs, and sizes in kB that their results do not fit in, one after the other, until they do.
RUNS = {
    "dataset": (command(*SET, "--out", "out/set", "--pack", "out/set.h5"), (12, 36, 76)),
    "dataset, 2 processes": (command(*SET, "--out", "out/set", "--workers", "2"), (20, 60)),
    "train": (command("train", "--preset", "smoke", "--threads", "1", "--out", "out/run"), (4, 100, 500)),
    "render": (command("render", "tabletop/kitchen", "--width", "32", "--height", "24", "--bounces", "1", "--out",
                       "out/a.exr"), (8, 24)),
    "study": (command("study", "multipath", "--preset", "smoke", "--out", "out/study"), (16, 400, 1000)),
}  # fmt: skip


@pytest.fixture(scope="module")
def apart(tmp_path_factory) -> Iterator[Warm]:
    """Children that may mount."""
    mount = [*UNSHARE, "mount", "-t", "tmpfs", "none", str(tmp_path_factory.mktemp("mounted"))]
    if not shutil.which("unshare") or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("no file system can be mounted in a name space of one's own")
    process = Warm(*UNSHARE)
    yield process
    process.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_full_disk_is_one_line_and_with_space_the_run_goes_on(apart, tmp_path, name):
    code, sizes = RUNS[name]
    whole, small, output = tmp_path / "whole", tmp_path / "small", tmp_path / "small/output.txt"
    for folder in (whole / "out", small / "out", tmp_path / "kept"):
        folder.mkdir(parents=True)
    whole_run(apart, Run(code), whole)

    def run(words: str) -> int | None:
        return apart.wait(apart.start(words, small, output))

    assert run("import os; os.system('mount -t tmpfs -o size=4k none out')") == 0
    for size in sizes:
        output.write_text("")
        status = run(f"import os; os.system('mount -o remount,size={size}k out')\n{code}")
        message = output.read_text()
        refused = re.findall(r"^scene2spad: out\S*: .*No space left on device.*$", message, flags=re.MULTILINE)
        assert status == 2 and len(refused) == 1 and "Traceback" not in message, (
            f"{size} kB: {status} {message[-2000:]}"
        )
    copied = f"import shutil; shutil.copytree('out', {str(tmp_path / 'kept/out')!r})"
    finished = (
        f"import os; os.system('mount -o remount,size=100m out')\ntry:\n    exec({code!r})\nfinally:\n    {copied}"
    )
    assert run(finished) == 0, output.read_text()[-2000:]
    unlike = ("timings.jsonl", "resume.ckpt")
    found, expected = (contents(folder, unlike) for folder in (tmp_path / "kept/out", whole / "out"))
    assert sorted(found) == sorted(expected)
    assert [file for file in found if found[file] != expected[file]] == []
