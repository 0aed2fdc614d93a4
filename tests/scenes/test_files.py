"""Files of ours: whole or not there, checked before a library trusts them, and within memory."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from scenes import InputError
from scenes.files import open_seal, read_array, read_arrays, whole_file
from scenes.io import hdf5 as hdf5_module
from scenes.io.hdf5 import USER_BLOCK, add_checksum, open_checked, read_dataset


def test_a_file_and_its_folder_are_flushed_before_and_after_the_rename(tmp_path, monkeypatch):
    """A rename may reach the disk before the bytes do: then a power cut leaves an empty file under the final name."""
    order, fsync, replace = [], os.fsync, Path.replace

    def flushed(descriptor: int) -> None:
        order.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        fsync(descriptor)

    def renamed(self: Path, target: Path) -> Path:
        order.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(Path, "replace", renamed)
    with whole_file(tmp_path / "a.txt") as beside:
        beside.write_text("all of it")
    assert order == [beside.name, "rename", tmp_path.name]
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_link_stays_and_the_file_that_it_leads_to_is_written(tmp_path):
    """The temporary file lies beside that file, which may be on another disk, and has the asked ending."""
    there = tmp_path / "there"
    there.mkdir()
    (tmp_path / "to-old.txt").symlink_to(there / "old.dat")
    (tmp_path / "to-new.txt").symlink_to("there/new.txt")  # dangles, and is relative
    (tmp_path / "twice.txt").symlink_to("to-old.txt")
    (there / "old.dat").write_text("old")
    for name, target in (("to-old.txt", "old.dat"), ("to-new.txt", "new.txt"), ("twice.txt", "old.dat")):
        with whole_file(tmp_path / name) as beside:
            assert beside.parent == there and beside.suffix == ".txt"
            beside.write_text(name)
        assert (tmp_path / name).is_symlink() and (there / target).read_text() == name
    assert {path.name for path in there.iterdir()} == {"old.dat", "new.txt"}


def test_links_that_lead_nowhere_are_refused_in_one_line(tmp_path):
    (tmp_path / "a.txt").symlink_to(tmp_path / "b.txt")
    (tmp_path / "b.txt").symlink_to(tmp_path / "a.txt")
    (tmp_path / "far.txt").symlink_to(tmp_path / "none/far.txt")
    for name, words in (("a.txt", "a.txt: is a link that leads back to itself"), ("far.txt", "none does not exist")):
        with pytest.raises(InputError, match=words), whole_file(tmp_path / name):
            pytest.fail("begun")
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", "b.txt", "far.txt"}


def test_a_deeply_nested_seal_is_no_seal_of_ours():
    with pytest.raises(InputError, match="not one of ours"):
        open_seal('{"a":' * 100_000, "histogram")


def test_arrays_of_every_layout_read_as_numpy_reads_them(tmp_path):
    rng = np.random.default_rng(0)
    for array in (
        rng.random(5),
        rng.random((2, 3)).astype(np.float32),
        np.asfortranarray(rng.random((3, 4))),
        np.eye(0),
    ):
        np.save(tmp_path / "a.npy", array)
        assert np.array_equal(read_array(tmp_path / "a.npy"), array)


def test_arrays_that_are_none_are_refused_in_one_line(tmp_path):
    np.save(tmp_path / "o.npy", np.array([{}], object), allow_pickle=True)
    np.save(tmp_path / "s.npy", np.zeros(3))
    data = (tmp_path / "s.npy").read_bytes()
    (tmp_path / "syntax.npy").write_bytes(data.replace(b"(3,)", b"(300"))
    for name, shape in (("huge", b"(3000000000000,), }"), ("negative", b"(-1, -3), }")):
        (tmp_path / f"{name}.npy").write_bytes(data.replace(b"(3,), }".ljust(len(shape)), shape))
    (tmp_path / "cut.npy").write_bytes(data[:-1])
    (tmp_path / "magic.npy").write_bytes(b"\0" * 8 + data[8:])
    for name in ("o", "syntax", "huge", "negative", "cut", "magic", "none"):
        with pytest.raises(InputError, match=rf"^[^\n]*{name}\.npy: [^\n]*$"):
            read_array(tmp_path / f"{name}.npy")


def test_archives_of_arrays_are_read_within_memory_and_refused_in_one_line(tmp_path, monkeypatch):
    written = {"a": np.arange(6.0).reshape(2, 3), "b": np.array(7)}
    np.savez_compressed(tmp_path / "good.npz", **written)
    found = read_arrays(tmp_path / "good.npz")
    assert found.keys() == written.keys() and all(np.array_equal(found[name], written[name]) for name in written)
    np.savez_compressed(tmp_path / "object.npz", a=np.array([{}], object))
    data = bytearray((tmp_path / "good.npz").read_bytes())
    (tmp_path / "cut.npz").write_bytes(data[:-30])
    data[60] ^= 1
    (tmp_path / "flipped.npz").write_bytes(data)
    for name in ("object", "cut", "flipped", "none"):
        with pytest.raises(InputError, match=rf"^[^\n]*{name}\.npz: [^\n]*$"):
            read_arrays(tmp_path / f"{name}.npz")
    np.savez_compressed(tmp_path / "bomb.npz", a=np.zeros(1 << 20))
    assert (tmp_path / "bomb.npz").stat().st_size < 20_000
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "0.01")
    with pytest.raises(InputError, match=r"bomb\.npz: its arrays: needs 0.0168 GB"):
        read_arrays(tmp_path / "bomb.npz")


def hdf5(path: Path, **datasets) -> Path:
    with h5py.File(path, "w", userblock_size=USER_BLOCK) as file:
        for name, made in datasets.items():
            made(file, name)
    add_checksum(path)
    return path


def test_a_flipped_bit_of_a_checked_file_is_seen_before_hdf5_reads_it(tmp_path):
    path = hdf5(tmp_path / "a.h5", x=lambda file, name: file.create_dataset(name, data=np.arange(10)))
    with open_checked(path) as file:
        assert (read_dataset(file, "x") == np.arange(10)).all()
    with h5py.File(path) as file:  # HDF5's own tools read it too
        assert (file["x"][:] == np.arange(10)).all()
    data = path.read_bytes()
    for byte in range(0, len(data), 37):
        path.write_bytes(data[:byte] + bytes([data[byte] ^ 4]) + data[byte + 1 :])
        with pytest.raises(InputError), open_checked(path):
            pass


def test_a_damaged_mark_does_not_pass_for_a_file_of_an_earlier_version(tmp_path, monkeypatch):
    """A bit of the mark and others of the data: refused by the mark, and never given to the HDF5 library."""
    path = hdf5(tmp_path / "a.h5", x=lambda file, name: file.create_dataset(name, data=np.arange(10)))
    data = bytearray(path.read_bytes())
    for byte in (13, USER_BLOCK + 900):
        data[byte] ^= 4
    path.write_bytes(data)
    monkeypatch.setattr("scenes.io.hdf5.in_child", lambda *_: pytest.fail("given to the library"))
    with pytest.raises(InputError, match="the mark of its checksum is damaged"), open_checked(path):
        pass


def test_a_probe_that_never_ends_is_stopped_by_its_processor_time(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "old.h5", "w") as file:
        file.create_dataset("x", data=np.arange(10))
    monkeypatch.setattr(hdf5_module, "_walk", lambda *_: next(n for n in itertools.count() if n < 0))
    monkeypatch.setattr(hdf5_module, "PROBE_SECONDS", 0.5)
    with pytest.raises(InputError, match="does not come to an end of it in 1 s"), open_checked(tmp_path / "old.h5"):
        pass


READER = """
import resource, sys
from pathlib import Path
from scenes.io.hdf5 import open_checked, read_dataset
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
for kind, most in ((resource.RLIMIT_AS, used + (1 << 30)), (resource.RLIMIT_CPU, 60)):
    resource.setrlimit(kind, (most, most))
with open_checked(Path(sys.argv[1])) as file:
    print(read_dataset(file, "x").sum())
"""


def test_a_file_is_read_within_limits_that_are_lower_than_those_of_its_probe(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    path = hdf5(tmp_path / "a.h5", x=lambda file, name: file.create_dataset(name, data=np.ones(4)))
    command = [sys.executable, "-c", READER, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "4.0\n"), done.stderr


def test_limits_that_cannot_be_set_are_told_apart_from_damage(tmp_path, monkeypatch):
    def refuse(*_) -> None:
        raise ValueError("not allowed")

    monkeypatch.setattr(hdf5_module, "_set_limit", refuse)
    path = hdf5(tmp_path / "a.h5", x=lambda file, name: file.create_dataset(name, data=np.ones(4)))
    with pytest.raises(InputError, match=r"no limits could be set .*\(not allowed\)"), open_checked(path):
        pass


def test_a_file_without_a_checksum_is_read_by_another_process_first(tmp_path):
    """As written before there were checksums; and damaged so that the library fails or never ends."""
    with h5py.File(tmp_path / "old.h5", "w") as file:
        file.create_dataset("x", data=np.arange(1000), chunks=(100,), compression="gzip")
    with open_checked(tmp_path / "old.h5") as file:
        assert (read_dataset(file, "x") == np.arange(1000)).all()
    data = (tmp_path / "old.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: len(data) // 2])
    (tmp_path / "none.h5").write_bytes(b"nothing" * 99)
    for name in ("cut.h5", "none.h5"):
        with pytest.raises(InputError), open_checked(tmp_path / name):
            pass


def test_datasets_larger_than_their_bytes_or_elsewhere_are_refused(tmp_path):
    (tmp_path / "raw.bin").write_bytes(bytes(80))
    hdf5(tmp_path / "other.h5", x=lambda file, name: file.create_dataset(name, data=np.arange(3)))
    virtual = h5py.VirtualLayout((3,), np.int64)
    virtual[:] = h5py.VirtualSource(tmp_path / "other.h5", "x", (3,))
    path = hdf5(
        tmp_path / "a.h5",
        bomb=lambda file, name: file.create_dataset(name, (10**9, 1000), np.int32, chunks=(1024, 1000)),
        external=lambda file, name: file.create_dataset(
            name, (10,), np.int64, external=[(tmp_path / "raw.bin", 0, 80)]
        ),
        link=lambda file, name: file.__setitem__(name, h5py.ExternalLink(str(tmp_path / "other.h5"), "x")),
        virtual=lambda file, name: file.create_virtual_dataset(name, virtual),
        words=lambda file, name: file.create_dataset(name, data="text"),
        group=lambda file, name: file.create_group(name),
    )
    with open_checked(path) as file:
        for name, why in (
            ("bomb", "states 4000000000000 bytes"),
            ("external", "another file"),
            ("virtual", "another file"),
        ):
            with pytest.raises(InputError, match=why):
                read_dataset(file, name)
        for name in ("link", "words", "group", "none"):
            with pytest.raises(InputError):
                read_dataset(file, name)


def test_a_small_histogram_that_states_gigabytes_is_refused_within_its_size(tmp_path):
    """7 kB that took 3.3 GB, and an unknown data set that took 3.5: read in a process with 1.5 GB."""
    code = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parents[1] / "support")!r})
from pathlib import Path
import h5py, json
import readers
from scenes import InputError
from scenes.io.hdf5 import add_checksum
from spad.measurements.histogram import read_histogram
path = Path({str(tmp_path / "h.h5")!r})
for extra in ("unknown", "counts"):
    readers.READERS["histogram"].make(path)
    with h5py.File(path, "r+") as file:
        if extra in file: del file[extra]
        file.create_dataset(extra, (900, 1000, 1000), "i4", chunks=(64, 100, 100), compression="gzip")
    add_checksum(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try: read_histogram(path)
    except InputError as error: print(json.dumps(str(error)))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == 2 and "unknown" in lines[0] and "states 3600000000 bytes" in lines[1]
