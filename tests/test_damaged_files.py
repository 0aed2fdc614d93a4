"""Damaged files of every kind that we read: refused in one line, or read as numbers that are finite.

Files with a checksum must be refused or equal the original. Others may hold another mesh or image after a flipped
digit, but never an infinite one. Seeds are fixed; a file that fails can be made again by reader and number.
"""

from __future__ import annotations

import logging
import os
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "support"))

from damage import MEMORY_BYTES, SECONDS, Verdict, damaged, read_all
from readers import READERS

from scenes.io.hdf5 import USER_BLOCK, add_checksum

log = logging.getLogger(__name__)


def judge(name: str, verdicts: list[Verdict], accepted: set[str]) -> None:
    """Find no fault in any verdict; what was found is logged (`pytest --log-cli-level=INFO`)."""
    outcomes = Counter(v.outcome for v in verdicts)
    seconds, memory_bytes = max(v.seconds for v in verdicts), max(v.memory_bytes for v in verdicts)
    log.info("%s: %d files, %s; at most %.2f CPU-s and %.0f MB", name, len(verdicts), dict(outcomes), seconds,
             memory_bytes / 1e6)  # fmt: skip
    faults = [v for v in verdicts if v.outcome not in accepted or v.seconds > SECONDS or v.memory_bytes > MEMORY_BYTES]
    assert not faults, f"{len(faults)} of {len(verdicts)}: {faults[:5]}"


def check(reader: str, count: int, folder: Path, first: int = 0) -> None:
    """Damage a good file `count` times, and read the copies in processes of their own."""
    of = READERS[reader]
    good = folder / f"good{of.suffix}"
    of.make(good)
    copies = folder / "copies"
    copies.mkdir()
    data = good.read_bytes()
    for number in range(first, first + count):
        rng = np.random.default_rng(np.random.SeedSequence(27, spawn_key=(list(READERS).index(reader), number)))
        (copies / f"d{number:05d}{of.suffix}").write_bytes(damaged(data, rng))
    verdicts = read_all(reader, copies, good)
    assert len(verdicts) == count
    accepted = {"refused", "same"} if of.checked else {"refused", "same", "changed"}
    judge(reader, verdicts, accepted)
    assert sum(v.outcome == "refused" for v in verdicts) > count // 20, "the damage was not damage"


@pytest.mark.parametrize("reader", READERS)
def test_damaged_files_are_refused_or_finite(reader: str, tmp_path: Path) -> None:
    check(reader, 24, tmp_path)


def check_resealed(reader: str, count: int, folder: Path) -> None:
    """Damage what lies behind the checksum of an HDF5 file, and make the checksum fit: the library meets the damage."""
    of = READERS[reader]
    good = folder / f"good{of.suffix}"
    of.make(good)
    copies = folder / "copies"
    copies.mkdir()
    data = good.read_bytes()
    for number in range(count):
        rng = np.random.default_rng(np.random.SeedSequence(28, spawn_key=(list(READERS).index(reader), number)))
        path = copies / f"d{number:05d}{of.suffix}"
        path.write_bytes(data[:USER_BLOCK] + damaged(data[USER_BLOCK:], rng) + b" ")
        add_checksum(path)
    verdicts = read_all(reader, copies, good)
    assert len(verdicts) == count
    judge(f"{reader}, sealed again", verdicts, {"refused", "same"})


@pytest.mark.parametrize("reader", ["histogram", "pack"])
def test_damage_behind_a_checksum_that_fits_is_refused(reader: str, tmp_path: Path) -> None:
    check_resealed(reader, 8, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("reader", ["histogram", "pack"])
def test_much_damage_behind_a_checksum_that_fits_is_refused(reader: str, tmp_path: Path) -> None:
    """Seven of these histograms make the HDF5 library loop for ever, which ends after five seconds each."""
    check_resealed(reader, 160, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_many_damaged_files_are_refused_or_finite(reader: str, tmp_path: Path) -> None:
    """Every reader, 640 files each: 16,000 of 25 readers."""
    check(reader, int(os.environ.get("DAMAGED_FILES", "640")), tmp_path, first=100)
