"""HDF5 files that may be damaged: checked before the HDF5 library sees them, and read within stated sizes.

The library trusts what a file states: a flipped bit can make it loop for ever or allocate petabytes. So the first 512
bytes of our files, HDF5's user block, hold a SHA-256 of all others. Files without one, of earlier versions or made by
others, are first read in a process of their own that may be killed.
"""

from __future__ import annotations

import hashlib
import io
import math
import mmap
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.errors import InputError, require
from scenes.limits import memory_limit, require_memory

if TYPE_CHECKING:
    import h5py

USER_BLOCK = 512
SIGNATURE = b"\x89HDF\r\n\x1a\n"
MARK = b"scene2spad SHA-256 of what follows byte 512: "
MAX_DEFLATE_RATIO = 1032  # of zlib's format
SLACK_BYTES = 1 << 16
# Of the processor, not of the clock: a busy machine must not make a sound file look damaged.
PROBE_SECONDS, PROBE_BYTES_PER_SECOND = 4, 20_000_000
WAITING = 15  # times as long by the clock
PROBE = """
import resource, sys, h5py
for kind, limit in zip((resource.RLIMIT_AS, resource.RLIMIT_CPU), map(int, sys.argv[2:])):
    resource.setrlimit(kind, (limit, limit))
with h5py.File(sys.argv[1], "r") as file:
    dict(file.attrs)
    for name in file:
        dataset = file[name]
        dataset.shape, dataset.dtype, dataset.id.get_storage_size()
        for chunk in dataset.iter_chunks() if dataset.chunks else ():
            dataset[chunk]
"""


class Sink(io.RawIOBase):
    """A file for HDF5 to write to, which keeps an error of writing to itself until `check` is called.

    Where HDF5 meets a full disk it prints tracebacks while it closes its objects, and may crash as the process ends.
    """

    def __init__(self, file: io.FileIO) -> None:
        self._file, self._error = file, None
        self.seek, self.tell, self.readinto = file.seek, file.tell, file.readinto

    def write(self, data: bytes) -> int:
        left = memoryview(data).cast("B")
        while self._error is None and len(left):
            try:
                left = left[self._file.write(left) :]
            except OSError as error:
                self._error = error
        return len(data)

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


def add_checksum(path: Path) -> None:
    """Write the checksum into the user block of a finished HDF5 file that was made with `userblock_size=512`."""
    with Path(path).open("r+b") as file:
        line = MARK + _digest(file).encode() + b"\n"
        file.seek(0)
        file.write(line.ljust(USER_BLOCK, b"\0"))


def _digest(file: object) -> str:
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
        else:
            # ours begin with the mark, or, made by earlier versions, with HDF5's own signature
            require(start.startswith(SIGNATURE), "is no HDF5 file of ours, or the mark of its checksum is damaged")
            _probe(path)
    with h5py.File(path, "r") as opened:
        yield opened


def _probe(path: Path) -> None:
    """Read a file without a checksum in another process; InputError where that dies, or takes too long."""
    seconds = math.ceil(PROBE_SECONDS + path.stat().st_size / PROBE_BYTES_PER_SECOND)
    limits = min(memory_limit(), 4 << 30), seconds
    command = [sys.executable, "-c", PROBE, str(path), *map(str, limits)]
    endless = f"the HDF5 library does not come to an end of it in {seconds} s: it is damaged"
    try:
        done = subprocess.run(command, capture_output=True, timeout=WAITING * seconds, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(endless) from None
    require(done.returncode not in (-signal.SIGXCPU, -signal.SIGKILL), endless)
    if done.returncode:
        words = (done.stderr.decode(errors="replace").split("\n")[-2:-1] or [""])[0]
        raise InputError(f"the HDF5 library cannot read it ({words[:120] or f'status {done.returncode}'})")


def read_dataset(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset whole after its stated size is compared with the bytes that the file holds of it.

    Raises InputError for a name that is no dataset inside this file, one of numbers only, and a size beyond what
    the stored bytes can hold or the memory limit allows.
    """
    import h5py

    inside = isinstance(file.get(name, getlink=True), h5py.HardLink)
    dataset = file[name] if inside else None
    require(isinstance(dataset, h5py.Dataset), f"{name} is no dataset of this file")
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
