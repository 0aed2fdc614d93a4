"""The transient's file: bit for bit, and every kind of damage refused in one line."""

import hashlib
import json
import re
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from render.transient import Transient, read_transient, write_transient
from render.transient.data import exr_bytes
from render.transient.exr_files import is_complete
from render.transient.samples import Samples, merge, to_returns
from scenes import InputError
from scenes.files import ATTRIBUTE
from spad.formats.depth_map import write_depth


def make(returns: int = 2000, height: int = 12, width: int = 16, seed: int = 0) -> Transient:
    rng = np.random.default_rng(seed)
    samples = Samples(
        rng.integers(0, height * width, returns),
        rng.uniform(1, 9, returns),
        rng.uniform(0, 0.01, returns),
        rng.exponential(1, returns),
        rng.integers(1, 9, returns).astype(np.uint8),
    )
    shape = (height, width)
    depth = rng.uniform(1, 5, shape).astype(np.float32)
    depth[0, 0] = np.nan
    return Transient(
        height,
        width,
        *to_returns(merge(samples, 0.01), height * width),
        depth_m=depth,
        normal=rng.normal(size=(*shape, 3)).astype(np.float16),
        albedo=rng.random(shape).astype(np.float16),
        ambient=rng.random(shape).astype(np.float32),
        mixed=rng.random(shape) > 0.5,
        error=rng.random(shape).astype(np.float32),
        meta={"scene": "noise", "seed": 2**40, "deep": {"list": [1, 2.5, "ü"]}},
    )


@pytest.mark.parametrize("returns", [0, 1, 3, 2000])
def test_read_back_bit_for_bit(tmp_path, returns):
    transient = make(returns)
    write_transient(transient, tmp_path / "t.exr")
    again = read_transient(tmp_path / "t.exr")
    for name in (
        "offsets",
        "path_near_m",
        "path_far_m",
        "radiance",
        "bounces",
        "depth_m",
        "normal",
        "albedo",
        "ambient",
    ):
        left, right = getattr(transient, name), getattr(again, name)
        assert left.dtype == right.dtype and left.tobytes() == right.tobytes(), name
    assert (transient.mixed == again.mixed).all() and transient.error.tobytes() == again.error.tobytes()
    assert again.meta == transient.meta
    assert [path.name for path in tmp_path.iterdir()] == ["t.exr"]


def test_same_transient_same_file(tmp_path):
    write_transient(make(), tmp_path / "a.exr")
    write_transient(make(), tmp_path / "b.exr")
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_truncated_at_any_length_is_refused(tmp_path, capfd):
    write_transient(make(300, 6, 8), tmp_path / "t.exr")
    data = (tmp_path / "t.exr").read_bytes()
    cut = tmp_path / "cut.exr"
    for length in [*range(0, len(data), max(1, len(data) // 150)), len(data) - 2, len(data) - 1]:
        cut.write_bytes(data[:length])
        with pytest.raises(InputError) as refused:
            read_transient(cut)
        assert "cut.exr" in str(refused.value) and "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", ""), "OpenEXR's own warnings must not reach the terminal"


def test_damaged_contents_are_refused(tmp_path):
    write_transient(make(300, 6, 8), tmp_path / "t.exr")
    data = bytearray((tmp_path / "t.exr").read_bytes())
    rng = np.random.default_rng(0)
    refused = 0
    for position in rng.integers(0, len(data), 200):
        damaged = data.copy()
        damaged[position] ^= 0x55
        (tmp_path / "d.exr").write_bytes(damaged)
        try:
            again = read_transient(tmp_path / "d.exr")
            assert again.sha256() == make(300, 6, 8).sha256() and again.meta == make(300, 6, 8).meta
        except InputError:
            refused += 1
    assert refused > 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 3}, "schema 3"),
        ({"kind": "depth"}, "holds a depth, expected a transient"),
        ({"kind": "dream"}, "not one of ours"),
        ({"seed": 5}, "do not match"),
        ({"sha256": "0"}, "do not match"),
    ],
)
def test_other_kinds_newer_schemas_and_altered_metadata_are_refused(tmp_path, change, message):
    import OpenEXR

    write_transient(make(300, 6, 8), tmp_path / "t.exr")
    with OpenEXR.File(str(tmp_path / "t.exr"), separate_channels=True) as file:
        parts = [OpenEXR.Part(dict(p.header), dict(p.channels), p.name()) for p in file.parts]
        meta = json.loads(parts[-1].header[ATTRIBUTE])
        parts[-1].header[ATTRIBUTE] = json.dumps({**meta, **change})
        OpenEXR.File(parts).write(str(tmp_path / "u.exr"))
    with pytest.raises(InputError, match=message):
        read_transient(tmp_path / "u.exr")


def test_foreign_and_missing_files_are_refused(tmp_path):
    import OpenEXR

    pixels = np.zeros((4, 4), np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": pixels}).write(str(tmp_path / "image.exr"))
    (tmp_path / "text.exr").write_text("not an image")
    for name, message in (("image.exr", "no transient"), ("text.exr", "not a readable"), ("none.exr", "not found")):
        with pytest.raises(InputError, match=message):
            read_transient(tmp_path / name)


def test_write_leaves_nothing_behind_when_it_fails(tmp_path, monkeypatch):
    import OpenEXR

    def full_disk(self, path):
        Path(path).write_bytes(b"half")
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(OpenEXR.File, "write", full_disk)
    with pytest.raises(InputError, match=r"t.exr: cannot be written .*No space left"):
        write_transient(make(), tmp_path / "t.exr")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="does not exist"):
        write_transient(make(), tmp_path / "nowhere" / "t.exr")


@pytest.mark.parametrize("lost", [1, 700, 6000])
def test_the_last_bytes_that_a_full_disk_takes_are_missed(tmp_path, lost):
    """OpenEXR swallows the error of its last buffer: the file ended early, and nothing was said."""
    transient = make(300, 6, 8)  # of few kilobytes: they all lie in that buffer
    write_transient(transient, tmp_path / "t.exr")
    size = (tmp_path / "t.exr").stat().st_size
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - lost, unlimited[1]))
    try:
        with pytest.raises(InputError, match=r"u.exr: cannot be written \(its last bytes were lost"):
            write_transient(transient, tmp_path / "u.exr")
        with pytest.raises(OSError, match="is the disk full"):
            exr_bytes(transient)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert [path.name for path in tmp_path.iterdir()] == ["t.exr"]


@pytest.mark.parametrize("height", [1, 16, 40])
def test_every_cut_of_a_file_is_seen(tmp_path, height):
    """Find it in a flat file of one part, a depth map, as in a transient of three."""
    depth = np.random.default_rng(0).random((height, 9)).astype(np.float32)
    write_depth(depth, tmp_path / "depth.exr", {})
    write_transient(make(50, height, 9), tmp_path / "transient.exr")
    for name in ("depth", "transient"):
        whole = (tmp_path / f"{name}.exr").read_bytes()
        assert is_complete(tmp_path / f"{name}.exr")
        for size in range(0, len(whole), 7 if len(whole) < 3000 else 97):
            (tmp_path / "cut.exr").write_bytes(whole[:size])
            assert not is_complete(tmp_path / "cut.exr"), size
        (tmp_path / "cut.exr").write_bytes(whole[:-1])
        assert not is_complete(tmp_path / "cut.exr")


def test_the_last_bytes_of_a_depth_map_are_missed_too(tmp_path):
    depth = np.random.default_rng(0).random((20, 20)).astype(np.float32)
    write_depth(depth, tmp_path / "t.exr", {})
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "t.exr").stat().st_size - 100, unlimited[1]))
    try:
        with pytest.raises(InputError, match=r"u.exr: cannot be written \(its last bytes were lost"):
            write_depth(depth, tmp_path / "u.exr", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)


def test_invalid_returns_are_refused_in_the_constructor():
    from dataclasses import replace

    good = make(50, 4, 4)
    with pytest.raises(InputError, match="negative"):
        replace(good, radiance=-good.radiance)
    with pytest.raises(InputError, match="reversed"):
        replace(good, path_near_m=good.path_far_m + 1)
    with pytest.raises(InputError, match="offsets"):
        replace(good, offsets=np.concatenate(([0], good.offsets[-2:0:-1], good.offsets[-1:])))
    with pytest.raises(InputError, match="depth_m"):
        replace(good, depth_m=good.depth_m[:2])


def test_delay_moves_paths_by_twice_the_offset():
    transient = make()
    later = transient.delayed(7.0)
    assert np.allclose(later.mean_path_m(), transient.mean_path_m() + 14, atol=1e-5, equal_nan=True)
    assert np.allclose(later.depth_m, transient.depth_m + 7, equal_nan=True)
    assert (later.radiance == transient.radiance).all() and later.delayed(1.0).meta["time_offset_m"] == 8.0


@pytest.mark.parametrize("offset", [-100.0, np.nan, np.inf, 1e300])
def test_a_delay_that_cannot_be_is_named(offset):
    transient = make()
    with pytest.raises(InputError, match=rf"^time offset {re.escape(f'{offset:g}')} m is outside -[\d.]+ to 10000$"):
        transient.delayed(offset)
    nearest = np.float32(min(transient.path_near_m.min() / 2, np.nanmin(transient.depth_m)))
    nearer = transient.delayed(-float(nearest))
    assert min(nearer.path_near_m.min(), np.nanmin(nearer.depth_m)) == 0
    behind = replace(transient, depth_m=np.full_like(transient.depth_m, 0.25))
    with pytest.raises(InputError, match=r"outside -0\.25 to"):
        behind.delayed(-0.5)


BAD = [(layer, bad) for layer in ("ambient", "error", "depth_m") for bad in (np.nan, -0.5, np.inf)]


@pytest.mark.parametrize(("layer", "bad"), BAD[:-3] + BAD[-2:])  # no depth is NaN
def test_one_bad_pixel_of_a_layer_is_refused(layer, bad):
    good = make(300, 6, 8)
    values = getattr(good, layer).copy()
    values[2, 3] = bad
    with pytest.raises(
        InputError, match=rf"1 of 48 values of {layer} are negative or not finite: .* in row 2, column 3"
    ):
        replace(good, **{layer: values})


def layers_of(transient: Transient) -> dict[str, np.ndarray]:
    return {"depth": transient.depth_m, "ambient": transient.ambient, "error": transient.error}


def test_flat_layers_in_float32_come_first(tmp_path):
    import OpenEXR

    write_transient(make(), tmp_path / "t.exr")
    with OpenEXR.File(str(tmp_path / "t.exr"), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == ["layers", "surface", "transient"]
        assert file.parts[0].type() == OpenEXR.scanlineimage and file.parts[2].type() == OpenEXR.deepscanline
        first = {name: channel.pixels for name, channel in file.parts[0].channels.items()}
    assert first.keys() == layers_of(make()).keys()
    for name, values in layers_of(make()).items():
        assert first[name].dtype == np.float32 and first[name].tobytes() == values.tobytes(), name


def test_mitsuba_reads_the_layers_without_rounding(tmp_path):
    from render.backend.llvm import start_mitsuba

    mi = start_mitsuba()
    write_transient(make(), tmp_path / "t.exr")
    import drjit as dr  # after its LLVM is chosen

    threads = dr.thread_count()
    dr.set_thread_count(max(threads, 2))  # Mitsuba waits for ever for an EXR file where there is one (1 CPU)
    bitmap = mi.Bitmap(str(tmp_path / "t.exr"))
    dr.set_thread_count(threads)
    names = [field.name for field in bitmap.struct_()]
    values = np.asarray(bitmap).reshape(12, 16, len(names))
    for name, layer in layers_of(make()).items():
        np.testing.assert_allclose(values[..., names.index(name)], layer, rtol=1e-6)


def test_a_viewers_library_reads_the_layers_without_rounding(tmp_path):
    """OpenImageIO is no dependency: CI leaves this out where it is not installed."""
    oiio = pytest.importorskip("OpenImageIO")
    write_transient(make(), tmp_path / "t.exr")
    image = oiio.ImageBuf(str(tmp_path / "t.exr"))
    names, values = image.spec().channelnames, image.get_pixels(oiio.FLOAT)
    for name, layer in layers_of(make()).items():
        np.testing.assert_allclose(values[..., names.index(name)], layer, rtol=1e-6)


def test_files_with_the_deep_part_first_still_open(tmp_path):
    """As version 1 of the file had it: the deep part, then one part of all layers."""
    import OpenEXR

    transient = make(300, 6, 8)
    write_transient(transient, tmp_path / "t.exr")
    with OpenEXR.File(str(tmp_path / "t.exr"), separate_channels=True) as file:
        parts = {p.name(): (dict(p.header), dict(p.channels)) for p in file.parts}
    header, deep = parts["transient"]
    body = {**transient.meta, "kind": "transient", "schema": 1}
    digest = hashlib.sha256((json.dumps(body, sort_keys=True) + transient.sha256()).encode()).hexdigest()
    header[ATTRIBUTE] = json.dumps({**body, "sha256": digest}, sort_keys=True)
    flat = parts["layers"][1] | parts["surface"][1]
    kept = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File([OpenEXR.Part(header, deep, "transient"), OpenEXR.Part(kept, flat, "layers")]).write(
        str(tmp_path / "old.exr")
    )
    again = read_transient(tmp_path / "old.exr")
    assert again.sha256() == transient.sha256() and again.meta == transient.meta
