"""Process groups as /proc shows them: processor time tells a hang from a machine that is busy, the clock does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

CPU_S, ASLEEP_S = 300.0, 300.0  # no group of a test uses so much, or sleeps so long without using any


def end_at_three(numbers: tuple[int, ...]) -> list[int]:
    """Work whose process dies at number 3, and not before others have had the time to begin."""
    if 3 in numbers:
        time.sleep(0.3)
        os._exit(1)
    time.sleep(0.1)
    return [*numbers]


def ended_process() -> int:
    """Return the number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def members(group: int) -> Iterator[list[str]]:
    """Yield what /proc tells of a group's living processes, from their state on."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            yield fields


def cpu_seconds(group: int) -> float:
    """Return the CPU time of a process group's members, and of their children that have ended [s]."""
    ticks = sum(int(ticks) for fields in members(group) for ticks in fields[11:15])
    return ticks / os.sysconf("SC_CLK_TCK")


def is_alone(group: int) -> bool:
    """Return whether no process of a group lives any more."""
    return next(members(group), None) is None


class Hang:
    """Watch a process group: it hangs when it has used `cpu_s` since, or slept `asleep_s` without using any."""

    def __init__(self, group: int, cpu_s: float = CPU_S, asleep_s: float = ASLEEP_S) -> None:
        self._group, self._cpu_s, self._asleep_s = group, cpu_s, asleep_s
        self._first = self._used = cpu_seconds(group)
        self._since = time.monotonic()

    def found(self) -> bool:
        """Look now, which should be done every second or so."""
        used = cpu_seconds(self._group)
        asleep = all(fields[0] not in "RD" for fields in members(self._group))
        if used != self._used or not asleep:
            self._used, self._since = used, time.monotonic()
        return used - self._first > self._cpu_s or time.monotonic() - self._since > self._asleep_s


def wait_for(condition: Callable[[], bool], group: int, step_s: float = 0.02) -> None:
    """Wait until a condition holds; AssertionError where the process group hangs before."""
    hang, looked = Hang(group), time.monotonic()
    while not condition():
        time.sleep(step_s)
        if time.monotonic() - looked > 1:
            looked = time.monotonic()
            assert not hang.found(), f"process group {group} hangs"


def run_process(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess:
    """Run a command to its end, its output kept as text; AssertionError where it hangs."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True, **options)
    hang = Hang(process.pid)
    while True:
        try:
            told = process.communicate(timeout=1)
            return subprocess.CompletedProcess(command, process.returncode, *told)
        except subprocess.TimeoutExpired:
            if not hang.found():
                continue
            os.killpg(process.pid, signal.SIGKILL)
            raise AssertionError(f"hangs: {command}") from None
