"""References in two halves, made in passes, kept in a folder under the hash of all that decides them."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from scene2spad.bench.rendering.errors import Reference
from scenes.errors import InputError
from scenes.files import read_arrays, whole_file
from scenes.io.versions import installed_version

log = logging.getLogger("scene2spad")
FORMAT = 3  # of what is kept, renders of studies too: another number forgets them within a version
FIRST_SEED = 1_000_000  # far from the seeds of what is judged


def default_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scene2spad"


def key_of(parts: dict) -> str:
    """Return a hash of everything that decides a render that is kept (plain JSON values), this version's code among
    it."""
    whole = {**parts, "format": FORMAT, "version": installed_version("scene2spad")}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:20]


def reference(
    folder: Path,
    name: str,
    parts: dict,
    passes: int,
    make: Callable[[int], np.ndarray],
    maker: str,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Reference:
    """Return both halves, from the folder or made now: `make(seed)` is one pass, (pixels, bins) float32.

    After every pass the half is saved, so that a stopped run goes on where it was.
    """
    folder.mkdir(parents=True, exist_ok=True)
    halves = []
    for half in range(2):
        path = folder / f"{name}-{key_of({**parts, 'passes': passes})}-{'AB'[half]}.npz"
        first = FIRST_SEED * (half + 1)
        report = partial(_report_half, progress, half, passes)
        halves.append(_half(path, passes, first, make, report))
    return Reference(halves[0], halves[1], maker)


def _report_half(progress: Callable[[float], None], half: int, passes: int, done: int) -> None:
    progress((half + done / passes) / 2)


def _half(
    path: Path, passes: int, first: int, make: Callable[[int], np.ndarray], progress: Callable[[int], None]
) -> np.ndarray:
    mean, done = _load(path)
    if mean is not None and done >= passes:
        return mean
    total = None if mean is None else mean.astype(np.float64) * done
    for number in range(done, passes):
        progress(number)
        part = make(first + number)
        total = part.astype(np.float64) if total is None else np.add(total, part, out=total)
        mean = (total / (number + 1)).astype(np.float32)
        with whole_file(path) as beside:
            np.savez_compressed(beside, mean=mean, passes=number + 1)
    assert mean is not None, "a reference of no pass"
    return mean


def _load(path: Path) -> tuple[np.ndarray | None, int]:
    if not path.is_file():
        return None, 0
    try:
        kept = read_arrays(path)
        return kept["mean"], int(kept["passes"])
    except (InputError, KeyError, TypeError):
        log.warning("%s: unreadable, made again", path)
        return None, 0
