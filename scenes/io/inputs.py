"""Files that users hand in: regular ones alone, text and JSON checked, names in them kept inside a folder."""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Iterator
from pathlib import Path

from scenes.errors import InputError, require
from scenes.json_types import JsonObject


def regular_file(path: Path, what: str = "file") -> Path:
    """Return `path` if it is a regular file, symbolic links followed.

    A device or pipe never ends, or never begins: opening one would hang. Raises InputError naming the path otherwise.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: {what} not found") from None
    except (OSError, ValueError) as error:  # a loop of links, a name with a zero byte or too long
        raise InputError(f"{path}: {what} cannot be looked up ({_reason(error)})") from None
    require(not stat.S_ISDIR(mode), f"{path}: {what} not found, it is a folder")
    require(stat.S_ISREG(mode), f"{path}: is a device, pipe or socket, expected a regular {what}")
    return path


def file_inside(folder: Path, name: str, what: str = "file", place: str = "the file's folder") -> Path:
    """Return the path of a file that another file names, which must be a regular one inside `folder`.

    Symbolic links are followed: one that points outside counts as outside. Backslashes are taken as slashes. Raises
    InputError whose message does not begin with a path, for the caller to say in which file the name stands.
    """
    path = folder / name.replace("\\", "/")
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
        there = path.exists()
        regular = path.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{what} {name!r} cannot be looked up ({_reason(error)})") from None
    require(inside, f"{what} {name!r} is outside {place}, copy it there")
    require(there, f"{what} {name!r} not found in {place}")
    require(regular, f"{what} {name!r} is not a regular file")
    return path


def read_bytes(path: Path, what: str = "file") -> bytes:
    """Return the contents of a regular file. Raises InputError naming it where it cannot be read."""
    path = regular_file(path, what)
    try:
        return path.read_bytes()
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read ({_reason(error)})") from None


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file's bytes. Raises InputError naming it where it cannot be read."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def read_text(path: Path, what: str = "text file", *, most_bytes: int | None = None) -> str:
    """Return the text of a regular UTF-8 file of `most_bytes` at the most. Raises InputError naming it otherwise."""
    path = regular_file(path, what)
    size = path.stat().st_size
    if most_bytes is not None:
        require(size <= most_bytes, f"{path}: {size} bytes, expected {most_bytes} at the most for a {what}")
    try:
        return read_bytes(path, what).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text, byte {error.start} is no UTF-8") from None


def parse_json(text: str | bytes) -> object:
    """Return what JSON text says. Raises InputError for anything else, too deep nesting among it."""
    try:
        return json.loads(text)
    except RecursionError:
        raise InputError("is nested too deeply to be read as JSON") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"is no JSON ({_reason(error)})") from None


def read_json_object(path: Path, what: str = "JSON file") -> JsonObject:
    """Return the JSON object of a file. Raises InputError naming the file where it holds something else."""
    try:
        found = parse_json(read_text(path, what))
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(str(path)) else f"{path}: {message}") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no JSON object")
    return found


def read_whole_lines(path: Path) -> Iterator[object]:
    """Yield what each line of a journal (JSON lines) says, in order; lines that cannot be read are passed over.

    A process that was killed while it appended leaves a cut line. Nothing where the file does not exist.
    """
    if not Path(path).exists():
        return
    for line in read_bytes(path).split(b"\n"):
        try:
            yield parse_json(line)
        except InputError:
            continue


def _reason(error: BaseException) -> str:
    """Return the first line of what an exception says, or its type."""
    text = getattr(error, "strerror", None) or str(error)
    return (text.splitlines() or [type(error).__name__])[0][:160]
