"""HDF5 files that may be damaged: checked before the HDF5 library sees them, and read within stated sizes.

The library trusts what a file states: a flipped bit can make it loop for ever or allocate petabytes. So the first 512
bytes of our files, HDF5's user block, hold a SHA-256 of all others. Somebody may have made the checksum fit: the
structure of every file is first walked through in a copy of the process that may be killed, and files without a
checksum, of earlier versions, are read there whole.
"""

from __future__ import annotations

import hashlib
import io
import math
import mmap
import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, NoReturn

import numpy as np

from scenes.errors import InputError, require
from scenes.limits import require_memory

if TYPE_CHECKING:
    import h5py
    from typing_extensions import Buffer

HDF5_SUFFIXES = (".h5", ".hdf5")  # one form of file, by either name
USER_BLOCK = 512
SIGNATURE = b"\x89HDF\r\n\x1a\n"
MARK = b"scene2spad SHA-256 of what follows byte 512: "
MAX_DEFLATE_RATIO = 1032  # of zlib's format
SLACK_BYTES = 1 << 16
# Of the processor, not of the clock: a busy machine must not make a sound file look damaged.
PROBE_SECONDS, PROBE_BYTES_PER_SECOND = 4, 20_000_000
PROBE_BYTES = 4 << 30
WAITING = 15  # times as long by the clock
UNREADABLE, UNLIMITED = 1, 2  # how the probe ends: the library cannot read the file, or no limits could be set


class Sink(io.RawIOBase):
    """A file for HDF5 to write to, which keeps an error of writing to itself until `check` is called.

    Where HDF5 meets a full disk it prints tracebacks while it closes its objects, and may crash as the process ends.
    """

    def __init__(self, file: io.FileIO) -> None:
        self._file = file
        self._error: OSError | None = None

    def seek(self, offset: int, whence: int = 0, /) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: Buffer, /) -> int | None:
        return self._file.readinto(buffer)

    def write(self, data: Buffer, /) -> int:
        left = memoryview(data).cast("B")
        while self._error is None and len(left):
            try:
                left = left[self._file.write(left) :]
            except OSError as error:
                self._error = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def check(self) -> None:
        """Raise the OSError of writing, if there was one."""
        if self._error is not None:
            raise self._error


@contextmanager
def new_hdf5(path: Path) -> Iterator[tuple[h5py.File, Sink]]:
    """Create an HDF5 file that can hold a checksum; OSError where its bytes cannot be written."""
    import h5py

    with path.open("w+b", buffering=0) as file:
        sink = Sink(file)
        try:
            with h5py.File(sink, "w", track_order=False, userblock_size=USER_BLOCK) as made:
                yield made, sink
        finally:
            sink.check()  # before what HDF5 made of it


def describe(file: h5py.File, notes: Mapping[str, tuple[str, str]]) -> None:
    """Give every dataset of a file its unit and its description, as attributes; `notes` has both by name."""
    for name, dataset in file.items():
        dataset.attrs["unit"], dataset.attrs["description"] = notes[name]


def add_checksum(path: Path) -> None:
    """Write the checksum into the user block of a finished HDF5 file that was made with `userblock_size=512`."""
    with Path(path).open("r+b") as file:
        line = MARK + _digest(file).encode() + b"\n"
        file.seek(0)
        file.write(line.ljust(USER_BLOCK, b"\0"))


def _digest(file: IO[bytes]) -> str:
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as contents:
        return hashlib.sha256(memoryview(contents)[USER_BLOCK:]).hexdigest()


@contextmanager
def open_checked(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading once its bytes are known to be sound.

    Raises InputError, without the file's name, for bytes that changed since the checksum was written, and for a file
    without one that another process cannot read in time.
    """
    import h5py

    with path.open("rb") as file:
        start = file.read(USER_BLOCK)
        if start.startswith(MARK):
            require(len(start) == USER_BLOCK, "is cut short")
            expected = start[len(MARK) : len(MARK) + 64].decode("ascii", "replace")
            blank = start[len(MARK) + 65 :].strip(b"\0") == b""
            size = path.stat().st_size
            sound = blank and size > USER_BLOCK and _digest(file) == expected
            require(sound, "its bytes do not match their SHA-256: the file is damaged or was altered")
            _probe(path, contents=False)
        else:
            # ours begin with the mark, or, made by earlier versions, with HDF5's own signature
            require(len(start) > 0, "the file is empty")
            require(start.startswith(SIGNATURE), "is no HDF5 file of ours, or the mark of its checksum is damaged")
            _probe(path, contents=True)
    with h5py.File(path, "r") as opened:
        yield opened


def _probe(path: Path, *, contents: bool) -> None:
    """Look into a file in a process of its own; InputError where that dies, or takes too long.

    Its structure is walked through, down to the places of all chunks, and `contents` reads these, too.
    """
    if not hasattr(os, "fork"):
        return
    seconds = math.ceil(PROBE_SECONDS + path.stat().st_size / PROBE_BYTES_PER_SECOND)
    status, words = in_child(lambda: _walk(path, contents), seconds)
    endless = f"the HDF5 library does not come to an end of it in {seconds} s: it is damaged"
    require(status not in (-signal.SIGXCPU, -signal.SIGKILL), endless)
    require(status != UNLIMITED, f"cannot be checked: no limits could be set for the process that does it ({words})")
    require(status == 0, f"the HDF5 library cannot read it ({words[:120] or f'status {status}'})")


def _walk(path: Path, contents: bool) -> None:
    import h5py

    with h5py.File(path, "r") as file:
        dict(file.attrs)
        for name in file:
            dataset = file[name]
            if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
                continue
            _ = dataset.dtype, dataset.id.get_storage_size()
            if dataset.chunks:
                for number in range(dataset.id.get_num_chunks()):
                    dataset.id.get_chunk_info(number)
            for chunk in dataset.iter_chunks() if contents and dataset.chunks else ():
                dataset[chunk]


def in_child(work: Callable[[], None], cpu_seconds: int) -> tuple[int, str]:
    """Do something in a copy of this process that may be killed: its status as of `subprocess`, and its last words.

    The copy has `cpu_seconds` of the processor and may allocate PROBE_BYTES, or what limits of this process leave.
    Nobody is inside HDF5 while it is made.
    """
    import h5py

    reading, writing = os.pipe()
    with h5py._hl.base.phil, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of copying a process with threads: this one stays in HDF5
        child = os.fork()
        if child == 0:
            _die_working(work, cpu_seconds, writing)
    os.close(writing)
    status = _wait_for(child, WAITING * cpu_seconds)
    with os.fdopen(reading, "rb") as words:
        return status, words.read(1 << 12).decode(errors="replace")


def _die_working(work: Callable[[], None], cpu_seconds: int, writing: int) -> NoReturn:
    """In the copy: work within limits, write what went wrong, and end without a word to anybody else."""
    import resource  # not on Windows

    status = UNLIMITED
    try:
        own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _set_limit(resource.RLIMIT_AS, own + PROBE_BYTES)
        _set_limit(resource.RLIMIT_CPU, cpu_seconds)
        status = UNREADABLE
        work()
        status = 0
    except BaseException as error:
        os.write(writing, " ".join(str(error).split())[:1000].encode())
    finally:
        os._exit(status)


def _set_limit(kind: int, wanted: int) -> None:
    """Limit a resource of this process; a hard limit that is lower already, as of `ulimit -v`, stays."""
    import resource

    hard = resource.getrlimit(kind)[1]
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(kind, (most, most))


def _wait_for(child: int, seconds: float) -> int:
    """Wait for a process, and kill it where it takes longer; its status, negative for a signal."""
    end, pause = time.monotonic() + seconds, 0.0005
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def read_dataset(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset whole after its stated size is compared with the bytes that the file holds of it.

    Raises InputError for a name that is no dataset inside this file, one of numbers only, and a size beyond what
    the stored bytes can hold or the memory limit allows.
    """
    import h5py

    inside = isinstance(file.get(name, getlink=True), h5py.HardLink)
    dataset = file[name] if inside else None
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{name} is no dataset of this file")
    require(dataset.dtype.kind in "biuf" and dataset.shape is not None, f"{name} holds no numbers")
    require(not dataset.is_virtual and not dataset.external, f"{name} lies in another file")
    size = dataset.dtype.itemsize
    for side in dataset.shape:
        size *= int(side)
    stored = dataset.id.get_storage_size()
    most = stored * (MAX_DEFLATE_RATIO if dataset.compression == "gzip" else 1) + SLACK_BYTES
    require(size <= most, f"{name} states {size} bytes, the {stored} that are stored hold at most {most}")
    require_memory(size, name)
    return np.asarray(dataset[()])
