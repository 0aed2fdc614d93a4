"""Folders of sets that are begun by hand, with views that no renderer made."""

from __future__ import annotations

from pathlib import Path

from scene2spad.datasets.set_folder import Done, SetFolder, file_name


def begun(path: Path, made: dict) -> SetFolder:
    """Return a set's folder that is made, or gone on with; nobody holds it, as after a kill."""
    folder = SetFolder(path, made)
    with folder.held():
        return folder


def finished(view: int, **more: object) -> Done:
    """Return a view of three bytes, with `more` in its record."""
    record = {"view": view, "file": file_name(view), "bytes": 3, "error": 0.01, "target": 0.02, "target_met": True}
    return Done(record | more, b"exr", 0.1, "here/1")
