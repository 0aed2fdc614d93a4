"""Packs: what comes back, how exactly, and what is refused."""

import re
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from render.transient import Transient
from render.transient.packs import (
    AMBIENT_STEPS,
    DEPTH_STEP_M,
    EXR_STEP_DIVISOR,
    PATH_STEP_M,
    RADIANCE_STEPS,
    WIDTH_STEP_M,
    read_pack,
    rounded,
    write_pack,
)
from scenes import InputError
from scenes.files import ATTRIBUTE
from scenes.io.hdf5 import add_checksum


def transient(seed: int, height: int = 6, width: int = 5) -> Transient:
    """Random returns: none, one or many a pixel, direct and indirect, holes, radiances over many decades."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, height * width)
    returns = int(counts.sum())
    near = np.sort(rng.uniform(0.5, 30, returns))
    shape = (height, width)
    depth = np.where(rng.random(shape) < 0.2, np.nan, rng.uniform(0.3, 15, shape)).astype(np.float32)
    return Transient(
        height,
        width,
        np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        near.astype(np.float32),
        (near + rng.uniform(0, 0.3, returns)).astype(np.float32),
        np.where(rng.random(returns) < 0.1, 0, 10 ** rng.uniform(-8, 1, returns)).astype(np.float32),
        rng.integers(1, 7, returns).astype(np.uint8),
        depth_m=depth,
        normal=np.zeros((*shape, 3), np.float16),
        albedo=rng.random(shape).astype(np.float16),
        ambient=(10 ** rng.uniform(-5, 0, shape)).astype(np.float32),
        mixed=rng.random(shape) < 0.3,
        error=np.zeros(shape, np.float32),
    )


VIEWS = [transient(seed) for seed in range(20)]


@pytest.fixture
def packed(tmp_path):
    path = tmp_path / "set.h5"
    assert write_pack(((view, {"view": i}) for i, view in enumerate(VIEWS)), path) == len(VIEWS)
    return path


def test_views_come_back_within_half_a_step(packed):
    pack = read_pack(packed)
    assert len(pack) == len(VIEWS) and [meta["view"] for meta in pack.metas] == list(range(len(VIEWS)))
    for given, got in zip(VIEWS, pack, strict=True):
        assert (got.offsets == given.offsets).all() and (got.bounces == given.bounces).all()
        assert (got.mixed == given.mixed).all() and (np.isnan(got.depth_m) == np.isnan(given.depth_m)).all()
        centre, expected = ((v.path_near_m.astype(float) + v.path_far_m) / 2 for v in (got, given))
        assert centre == pytest.approx(expected, abs=0.51 * PATH_STEP_M)
        width, expected = (v.path_far_m.astype(float) - v.path_near_m for v in (got, given))
        assert width == pytest.approx(expected, abs=0.51 * WIDTH_STEP_M)
        assert got.radiance == pytest.approx(given.radiance, rel=2 ** (0.51 / RADIANCE_STEPS) - 1)
        assert got.depth_m == pytest.approx(given.depth_m, abs=0.51 * DEPTH_STEP_M, nan_ok=True)
        assert got.ambient == pytest.approx(given.ambient, rel=2 ** (0.51 / AMBIENT_STEPS) - 1)
        assert got.albedo.astype(float) == pytest.approx(given.albedo.astype(float), abs=2.5e-3)
    with pytest.raises(IndexError):
        pack[len(VIEWS)]


def test_same_views_same_bytes(packed, tmp_path):
    write_pack(((view, {"view": i}) for i, view in enumerate(VIEWS)), tmp_path / "again.h5")
    assert (tmp_path / "again.h5").read_bytes() == packed.read_bytes()


def test_rounding_changes_little_and_only_once():
    once = rounded(VIEWS[0])
    assert rounded(once).sha256() == once.sha256()
    assert once.radiance == pytest.approx(VIEWS[0].radiance, rel=2**-11)
    assert once.path_near_m == pytest.approx(VIEWS[0].path_near_m, abs=0.51 * PATH_STEP_M / EXR_STEP_DIVISOR)


def test_a_pack_is_read_without_renderer_exr_or_command_line(packed):
    program = f"import sys; from render.transient.packs import read_pack; print(len(read_pack({str(packed)!r})),"
    program += " [m for m in ('mitsuba', 'drjit', 'OpenEXR', 'tyro', 'torch') if m in sys.modules])"
    message = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert message.strip() == f"{len(VIEWS)} []"


def test_damage_is_refused_in_one_line(packed, tmp_path):
    content = packed.read_bytes()
    for size in (0, 100, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.h5").write_bytes(content[:size])
        with pytest.raises(InputError, match=r"^[^\n]*cut\.h5[^\n]*$"):
            read_pack(tmp_path / "cut.h5")
    with h5py.File(packed, "r+") as file:
        file["first radiance"][3] += 1
    with pytest.raises(InputError, match="bytes do not match their SHA-256"):
        read_pack(packed)
    add_checksum(packed)
    with pytest.raises(InputError, match="SHA-256"):
        read_pack(packed)
    with h5py.File(packed, "r+") as file:
        file.attrs[ATTRIBUTE] = file.attrs[ATTRIBUTE].replace('"schema": 2', '"schema": 1')
    add_checksum(packed)
    with pytest.raises(InputError, match="pack of schema 1, this program reads 2"):
        read_pack(packed)
    with pytest.raises(InputError, match="not found"):
        read_pack(tmp_path / "none.h5")


def test_what_does_not_fit_is_refused(tmp_path):
    far = replace(VIEWS[0], depth_m=np.full((6, 5), 1e6, np.float32))
    for views, why in (([], "no view"), ([VIEWS[0], transient(1, 7, 5)], "not"), ([far], "over")):
        with pytest.raises(InputError, match=why):
            write_pack(((view, {}) for view in views), tmp_path / "x.h5")
    assert not list(tmp_path.iterdir())


def test_what_is_too_dark_for_a_pack_is_dark(tmp_path):
    """Below 2^-32 there is no code but that of 0."""
    radiance = np.zeros(VIEWS[0].returns, np.float32)
    radiance[:4] = 1e-15, 1e-10, 2.0**-32, 2.0**-31
    write_pack([(replace(VIEWS[0], radiance=radiance), {})], tmp_path / "dark.h5")
    got = np.sort(read_pack(tmp_path / "dark.h5")[0].radiance)[-4:]
    assert got.tolist() == [0, 0, 0, 2.0**-31]


def test_attributes_tell_another_program_how_to_read_steps_and_codes(packed):
    """Steps were cut off, and a logarithmic code had no zero point."""
    with h5py.File(packed) as file:
        steps = {name: float(file[name].attrs["unit"].removesuffix(" m")) for name in ("depth", "first centre")}
        described, codes = str(file["ambient"].attrs["description"]), file["ambient"][0].astype(float)
    assert steps == {"depth": DEPTH_STEP_M, "first centre": PATH_STEP_M}
    found = re.search(r"code c > 0 is 2\^\(c / (\d+) - (\d+)\), 0 is 0", described)
    assert found is not None
    light = np.where(codes > 0, 2 ** (codes / int(found[1]) - int(found[2])), 0)
    np.testing.assert_allclose(light, read_pack(packed)[0].ambient, rtol=1e-6)
