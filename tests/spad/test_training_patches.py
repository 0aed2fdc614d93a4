"""Patches on the fly: the law, the crop, the labels, and that the seed alone decides."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from scenes.errors import InputError
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.detection.training_patches import Patch, pack_views, sense_patches
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.model import PhotonBudget, Sensor

SENSOR = Sensor(bins=128, dark_count_rate_hz=(30.0, 0.0))


def scenes(count: int = 3, height: int = 12, width: int = 10) -> list:
    rng = np.random.default_rng(5)
    made = []
    for _ in range(count):
        depth = rng.uniform(0.3, 1.6, (2 * height, 2 * width))
        depth[rng.random(depth.shape) < 0.1] = np.nan
        image = rng.uniform(0.2, 1, depth.shape)
        made.append(transient_from_rgbd(depth, image, image, block=2))
    return made


def test_counts_follow_the_full_frames_rates() -> None:
    """Means and dispersion of 1500 draws of a crop, against the expected counts of the whole scene."""
    transients = scenes()
    packed = pack_views(transients)
    patches = [Patch(1, 3, 4, 6.0, 4.0, seed=(9, i)) for i in range(1500)]
    counts = sense_patches(packed, SENSOR, patches, size=(4, 5)).counts
    assert counts.shape == (1500, 1, 128, 4, 5) and counts.dtype == torch.float32
    rates = rates_for(transients[1], SENSOR, PhotonBudget(6, 4))
    expected = expected_counts(transients[1], SENSOR, rates, slice(0, 120))[0].numpy().reshape(12, 10, 128)
    expected = 1500 * np.moveaxis(expected[3:7, 4:9], -1, 0)
    total = counts.sum(dim=(0, 1)).double().numpy()
    tail = np.minimum(stats.poisson.cdf(total, expected), stats.poisson.sf(total - 1, expected))
    assert 2 * tail.min() > 1 - (1 - 1e-3) ** (1 / total.size)
    assert abs(total.sum() - expected.sum()) < 4 * np.sqrt(expected.sum())
    per_patch = counts.sum(dim=(1, 2, 3, 4)).numpy()
    assert per_patch.var() == pytest.approx(expected.sum() / 1500, rel=4.5 * np.sqrt(2 / 1500))


def test_labels_and_masks_are_the_crops() -> None:
    transients = scenes()
    batch = sense_patches(pack_views(iter(transients)), SENSOR, [Patch(2, 1, 2, 5, 5, 0)], size=(6, 7))
    depth = transients[2].depth_m[1:7, 2:9]
    assert np.array_equal(batch.depth_m[0].numpy(), depth, equal_nan=True)
    assert np.array_equal(batch.mixed[0].numpy(), transients[2].mixed[1:7, 2:9])
    assert np.array_equal(batch.valid[0].numpy(), depth < SENSOR.range_m)


def test_labels_that_the_bins_do_not_reach_are_not_valid() -> None:
    """The period goes on after the last bin, and the pulse of such a label has no bin at all."""
    packed = pack_views(scenes()[:1])
    ends = float(np.nanmedian(packed.depth_m))
    gated = replace(SENSOR, bins=int(ends / SENSOR.bin_depth_m), period_s=SENSOR.period_s)
    batch = sense_patches(packed, gated, [Patch(0, 0, 0, 5, 5, 0)], size=packed.depth_m.shape[1:])
    held = packed.depth_m < gated.bins * gated.bin_depth_m
    assert np.array_equal(batch.valid.numpy(), held) and 0 < held.sum() < held.size


def test_the_seed_decides_and_nothing_else() -> None:
    packed = pack_views(scenes())
    patches = [Patch(i % 3, i % 5, i % 4, 20, 10, seed=(1, i)) for i in range(8)]
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        together = sense_patches(packed, SENSOR, patches, size=(5, 5)).counts
        torch.set_num_threads(1)
        alone = torch.cat([sense_patches(packed, SENSOR, [patch], size=(5, 5)).counts for patch in patches])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(together, alone)
    other = sense_patches(packed, SENSOR, [patches[0]._replace(seed=(2, 0))], size=(5, 5)).counts
    assert not torch.equal(other, together[:1])


def test_time_offset_moves_counts_and_label_only_when_asked() -> None:
    packed = pack_views(scenes())
    sensor = replace(SENSOR, bins=1024, period_s=None)
    offset = 300 * sensor.bin_depth_m
    here, there = (
        sense_patches(packed, sensor, [Patch(0, 0, 0, 50, 0, 3, move)], size=(8, 8)) for move in (0.0, offset)
    )
    moved = torch.roll(here.counts, 300, dims=2)
    assert (moved != there.counts).sum() <= 4, "rounding may push a photon over a bin's edge"
    assert torch.allclose(there.depth_m, here.depth_m + offset, equal_nan=True)


@pytest.mark.parametrize("signal", [300.0, 40_000.0])
def test_full_pixels_are_counted_in_wider_types(signal: float) -> None:
    """More detections a pixel than a byte and than 16 bits hold: the totals stay."""
    packed = pack_views(scenes())
    counts = sense_patches(packed, SENSOR, [Patch(0, 0, 0, signal, 0.0, 6)], size=(12, 10)).counts
    expected = signal * 120
    assert abs(float(counts.sum(dtype=torch.float64)) - expected) < 4.5 * np.sqrt(expected)
    assert float(counts.sum(dim=2).max()) > signal and float(counts.min()) == 0


def test_bad_patches_are_refused() -> None:
    packed = pack_views(scenes())
    for patch in (Patch(3, 0, 0, 1, 1, 0), Patch(0, 9, 0, 1, 1, 0), Patch(0, 0, -1, 1, 1, 0)):
        with pytest.raises(InputError, match="outside"):
            sense_patches(packed, SENSOR, [patch], size=(4, 4))
    with pytest.raises(InputError, match="cannot be packed"):
        pack_views([scenes(1)[0], scenes(1, 4, 4)[0]])
    dark = replace(scenes(1)[0], radiance=np.zeros_like(scenes(1)[0].radiance))
    with pytest.raises(InputError, match="no light"):
        sense_patches(pack_views([dark]), SENSOR, [Patch(0, 0, 0, 1, 1, 0)], size=(4, 4))
    with pytest.raises(InputError, match="belong together"):
        replace(packed, ambient=packed.ambient[:1])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_gives_the_same_counts() -> None:
    packed, patches = pack_views(scenes()), [Patch(0, 1, 1, 30, 20, 4)]
    ours, theirs = (sense_patches(packed, SENSOR, patches, size=(8, 8), device=d).counts for d in ("cpu", "cuda"))
    assert torch.equal(ours, theirs.cpu())
