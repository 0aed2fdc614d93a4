"""Store what a study has computed so far, a line each: a run that was stopped anywhere repeats nothing that was
finished."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from scenes.files import append_line, whole_file
from scenes.io.inputs import read_whole_lines
from scenes.json_types import JsonObject


class Store:
    """Values by (digest of the model, key): a file of lines for each model, only ever appended to.

    A line that was cut when the process was killed is not there; the next begins on a line of its own.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self._known: dict[str, JsonObject] = {}

    def get(self, digest: str, **key: object) -> Any:
        """Return the value, or None."""
        return self._of(digest).get(_text(key))

    def put(self, digest: str, value: object, **key: object) -> None:
        known = self._of(digest)
        path = self.folder / f"{digest[:32]}.jsonl"
        append_line(path, json.dumps([_text(key), value]))
        known[_text(key)] = value

    def map_file(self, digest: str, **key: object) -> Path:
        """Return where a depth map of that key lies, if it does."""
        message = "-".join(f"{value:g}" if isinstance(value, float) else str(value) for value in key.values())
        return self.folder / "maps" / f"{digest[:16]}-{message}.npy"

    def put_map(self, depth_m: np.ndarray, digest: str, **key: object) -> None:
        path = self.map_file(digest, **key)
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as beside:
            np.save(beside, depth_m.astype(np.float32))

    def _of(self, digest: str) -> dict[str, object]:
        if digest not in self._known:
            self._known[digest] = dict(_lines(self.folder / f"{digest[:32]}.jsonl"))
        return self._known[digest]


def _text(key: dict[str, object]) -> str:
    return json.dumps(key, sort_keys=True)


def _lines(path: Path) -> list[tuple[str, object]]:
    found = []
    for line in read_whole_lines(path):
        match line:
            case [str(key), value]:
                found.append((key, value))
    return found
