"""Files of ours: written whole or not at all, and sealed, so that a reader sees neither half of one nor damage."""

from __future__ import annotations

import csv
import ctypes
import hashlib
import io
import json
import math
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import lru_cache
from pathlib import Path
from tokenize import TokenError
from typing import IO
from zipfile import ZipFile

import numpy as np

from scenes.errors import InputError, require
from scenes.io.inputs import parse_json, read_text, regular_file
from scenes.json_types import JsonObject
from scenes.limits import require_memory

ATTRIBUTE = "scene2spad"
# numpy's header is Python, and so are the errors of a damaged one
_NPY_ERRORS = (OSError, ValueError, KeyError, EOFError, SyntaxError, TypeError, RecursionError, TokenError, MemoryError)
SCHEMAS = {"transient": 2, "histogram": 1, "depth": 1, "pack": 2, "network": 1}
OLDER = {"transient": (1,)}  # schemas that are still read; they differ in where things lie in the file


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` to write to; renamed to `path` at the end, removed if anything goes wrong.

    Where `path` is a link, the file that it leads to is written, and the link stays. What killed processes of this
    machine left in the folder is removed before the first file goes there. Raises InputError in one line when the
    folder is missing, the disk is full, or writing is not allowed.
    """
    suffix = Path(path).suffix  # stays last, that of a link too: some libraries choose the format by it
    path = link_target(Path(path))
    beside = path.with_name(f".{path.stem[:80]}.{_machine()}.{os.getpid()}.part{suffix}")
    try:
        if not path.parent.is_dir():
            raise InputError(without_folder(path))
        if path.is_dir():
            raise InputError(f"{path}: is a folder, expected a file name")
        _sweep_once(path.parent.resolve())
        try:
            yield beside
            _flush_to_disk(beside)
            beside.replace(path)
            _flush_to_disk(path.parent)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or str(error).splitlines()[0]})") from None


def without_folder(path: Path) -> str:
    """Say why a file cannot be written that has no folder: a file is in its place, or nothing is."""
    there = next((one for one in path.parents if one.exists()), path.parent)
    missing = f"folder {path.parent} does not exist"
    return f"{path}: {f'{there} is a file, expected a folder' if there.is_file() else missing}"


def link_target(path: Path) -> Path:
    """Return the file that a symbolic link leads to, there or not; another path as it is. InputError for a loop."""
    if not path.is_symlink():
        return path
    target = Path(os.path.realpath(path))
    require(not target.is_symlink(), f"{path}: is a link that leads back to itself")
    return target


def _machine() -> str:
    """Return the name of this machine, or container: process numbers mean something on it alone."""
    return os.uname().nodename[:40]


def sweep(folder: Path) -> None:
    """Remove the temporary files in a folder whose processes, of this machine, are gone."""
    for path in abandoned_files(folder):
        owner = re.search(rf"\.{re.escape(_machine())}\.(\d{{1,9}})\.part", path.name)
        if owner is not None and not _is_running(int(owner[1])):
            path.unlink(missing_ok=True)


_sweep_once = lru_cache(maxsize=1024)(sweep)  # a process: a set's folder may hold a million files


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def abandoned_files(folder: Path) -> list[Path]:
    """Return the temporary files of `whole_file` in a folder: what killed processes left, unless somebody writes."""
    return sorted(folder.glob(".*.part*"))


def is_unclaimed(folder: Path) -> bool:
    """Tell whether a folder is not there, or holds nothing but what a process left that was killed at its start."""
    if not folder.exists():
        return True
    return folder.is_dir() and {*folder.iterdir()} <= {*abandoned_files(folder)}


def append_line(path: Path, text: str) -> None:
    """Append one line to a journal, which `scenes.io.inputs.read_whole_lines` reads.

    A kill or a full disk costs no more than the line that it cuts: the next begins on a line of its own. Raises
    InputError naming the file where it cannot be written.
    """
    try:
        with path.open("ab+") as file:
            cut = file.tell() > 0 and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n"
            file.write(b"\n" * cut + text.encode() + b"\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None


def _flush_to_disk(path: Path) -> None:
    """Wait until a file's bytes, or a folder's names, are on the disk: a rename alone survives no power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_array(path: Path) -> np.ndarray:
    """Read one array of numbers from a .npy file.

    Raises InputError in one line that names the file: missing, no .npy file, cut short, of objects, with a stated
    shape that is not that of its bytes, or larger than the memory limit.
    """
    path = regular_file(Path(path), "array file")
    try:
        size = path.stat().st_size
        require_memory(2 * size, "its array")
        with path.open("rb") as file:
            return npy_array(file, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except _NPY_ERRORS as error:
        raise InputError(f"{path}: not a readable .npy file ({' '.join(str(error).split())[:80]})") from None


def read_arrays(path: Path, what: str = "array file", names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read arrays of numbers from a .npz file, by name: all of them, or those of `names` that it holds. `what` the file
    is called where it is not found.

    Raises InputError in one line that names the file: as `read_array` does, and where a checksum does not fit.
    """
    path = regular_file(Path(path), what)
    found = {}
    try:
        with ZipFile(path) as archive:
            entries = archive.infolist()
            require_memory(2 * sum(entry.file_size for entry in entries), "its arrays")
            for entry in entries:
                name = entry.filename.removesuffix(".npy")
                with archive.open(entry) as file:  # of others, too: where a name is damaged, its two copies differ
                    if names is None or name in names:
                        found[name] = npy_array(file, entry.file_size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # what zipfile raises for damaged directories is of many types
        raise InputError(f"{path}: not a readable .npz file ({' '.join(str(error).split())[:80]})") from None
    return found


def npy_array(file: IO[bytes], size: int, kinds: str = "biuf", name: str = "") -> np.ndarray:
    """Read one array from a file of .npy format with so many bytes; nothing is allocated before its shape is checked.

    Raises InputError, which begins with the array's `name`, for another kind of values (NumPy's letters `kinds`; one
    text alone is taken) and a shape that is not that of the bytes; ValueError and others of NumPy for a damaged header.
    """
    version = np.lib.format.read_magic(file)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, columns_first, dtype = header[version](file)
    require(dtype.kind in kinds, f"{name} holds {dtype}, expected {'text' if kinds == 'U' else 'numbers'}".strip())
    require(kinds != "U" or shape == (), f"{name} holds texts of shape {shape}, expected one".strip())
    left = size - file.tell()
    fits = min(shape, default=0) >= 0 and math.prod(shape) * dtype.itemsize == left
    require(fits, f"{name} states shape {shape} of {dtype}, {left} bytes follow".strip())
    values = np.frombuffer(bytearray(file.read(left)), dtype)
    return values.reshape(shape, order="F" if columns_first else "C")


def read_csv(path: Path) -> list[dict[str, str]]:
    """Read the rows of a table, each by the names of its head.

    Raises InputError in one line that names the file: missing, no text, no table, or rows of other lengths than its
    head.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, "table"), newline=""), strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: not a readable table ({error})") from None
    uneven = next((number for number, row in enumerate(rows, 1) if None in row or None in row.values()), None)
    require(uneven is None, f"{path}: row {uneven} is of another length than the head of the table")
    return rows


def write_csv(rows: Sequence[Mapping[str, object]], path: Path) -> Path:
    """Write rows of the same keys as a table, whole or not at all; returns the path."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [*rows[0]], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with whole_file(path) as beside:
        beside.write_text(text.getvalue())
    return path


def seal(meta: JsonObject, kind: str, arrays_sha256: str) -> str:
    """Return the JSON that a file of ours carries: `meta`, its kind and schema, and a SHA-256 over these and the
    arrays.

    Raises InputError for metadata that JSON cannot hold.
    """
    body = {**meta, "kind": kind, "schema": SCHEMAS[kind]}
    try:
        return json.dumps({**body, "sha256": _digest(body, arrays_sha256)}, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{kind}: its metadata hold what JSON cannot: {error}") from None


def open_seal(text: str, kind: str) -> tuple[JsonObject, str]:
    """Return metadata and SHA-256 of a sealed file of the expected kind; `check_seal` follows when the arrays are read.

    Raises InputError if it is something else, or of a newer schema.
    """
    try:
        body = parse_json(text)
    except InputError:
        body = None
    if not isinstance(body, dict) or body.get("kind") not in SCHEMAS:
        raise InputError(f"its {ATTRIBUTE} attribute is not one of ours, expected a {kind}")
    if body["kind"] != kind:
        raise InputError(f"holds a {body['kind']}, expected a {kind}")
    if body.get("schema") not in (SCHEMAS[kind], *OLDER.get(kind, ())):
        raise InputError(
            f"{kind} of schema {body.get('schema')}, this program reads {SCHEMAS[kind]}; use another scene2spad"
        )
    return body, str(body.pop("sha256", ""))


def check_seal(body: JsonObject, sha256: str, arrays_sha256: str) -> JsonObject:
    """Return the metadata as it was given to `seal`; InputError where metadata or arrays changed since."""
    if _digest(body, arrays_sha256) != sha256:
        raise InputError("contents do not match their SHA-256: the file is damaged or was altered")
    return {key: value for key, value in body.items() if key not in ("kind", "schema")}


def _digest(body: JsonObject, arrays_sha256: str) -> str:
    return hashlib.sha256((json.dumps(body, sort_keys=True) + arrays_sha256).encode()).hexdigest()


@contextmanager
def silenced() -> Iterator[None]:
    """Send what Python and C code print to stdout and stderr to nowhere."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C still holds in its buffers belongs to nowhere too
        for descriptor, copy in enumerate(saved, start=1):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(nowhere)


def finite(value: object) -> object:
    """Return a value with None for every number that JSON does not know, NaN and infinities, in lists and dicts too."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
