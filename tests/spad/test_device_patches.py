"""Patches sensed on the device that trains, against the plain twin's law, labels and seeds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from scenes.errors import InputError
from spad.detection.device_patches import DevicePatches
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.detection.training_patches import Patch, joined, pack_views, sense_patches
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse, SampledPulse

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


@pytest.mark.parametrize(
    "sensor",
    [
        SENSOR,
        replace(SENSOR, pulse=Pulse(100e-12, 150e-12), jitter=Pulse(80e-12)),
        replace(SENSOR, pulse=SampledPulse((1, 5, 9, 4, 2, 1), 90e-12)),
        replace(SENSOR, period_s=200 * SENSOR.bin_width_s),
    ],
    ids=["gaussian", "tail and jitter", "measured", "gated"],
)
def test_counts_follow_the_full_frames_rates(sensor: Sensor) -> None:
    """Means and dispersion of 1500 draws of a crop, against the expected counts of the whole scene."""
    transients = scenes()
    resident = DevicePatches(pack_views(transients), sensor, "cpu")
    counts = resident.sense([Patch(1, 3, 4, 6.0, 4.0, seed=0)] * 1500, size=(4, 5), seed=9).counts
    assert counts.shape == (1500, 1, 128, 4, 5) and counts.dtype == torch.float32
    rates = rates_for(transients[1], sensor, PhotonBudget(6, 4))
    expected = expected_counts(transients[1], sensor, rates, slice(0, 120))[0].numpy().reshape(12, 10, 128)
    expected = 1500 * np.moveaxis(expected[3:7, 4:9], -1, 0)
    total = counts.sum(dim=(0, 1)).double().numpy()
    tail = np.minimum(stats.poisson.cdf(total, expected), stats.poisson.sf(total - 1, expected))
    assert 2 * tail.min() > 1 - (1 - 1e-3) ** (1 / total.size)
    assert abs(total.sum() - expected.sum()) < 4 * np.sqrt(expected.sum())
    per_patch = counts.sum(dim=(1, 2, 3, 4)).numpy()
    assert per_patch.var() == pytest.approx(expected.sum() / 1500, rel=4.5 * np.sqrt(2 / 1500))


def test_labels_masks_and_offsets_are_the_plain_twins() -> None:
    packed = pack_views(scenes())
    patches = [Patch(2, 1, 2, 5, 5, 0, 0.3), Patch(0, 4, 1, 5, 5, 1)]
    mine = DevicePatches(packed, SENSOR, "cpu").sense(patches, size=(6, 7), seed=0)
    plain = sense_patches(packed, SENSOR, patches, size=(6, 7))
    assert torch.equal(mine.depth_m.nan_to_num(-1), plain.depth_m.nan_to_num(-1))
    assert torch.equal(mine.mixed, plain.mixed) and torch.equal(mine.valid, plain.valid)


def test_no_patches_are_an_empty_batch_like_the_plain_twins() -> None:
    packed = pack_views(scenes())
    mine = DevicePatches(packed, SENSOR, "cpu").sense([], size=(6, 7), seed=0)
    plain = sense_patches(packed, SENSOR, [], size=(6, 7))
    for ours, theirs in zip(mine, plain, strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype and not len(ours)


def test_one_seed_gives_one_batch() -> None:
    resident = DevicePatches(pack_views(scenes()), SENSOR, "cpu")
    patches = [Patch(1, 0, 0, 20, 10, 0)] * 2
    first, again, other = (resident.sense(patches, size=(5, 5), seed=seed).counts for seed in ((1, 2), (1, 2), (1, 3)))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])  # patches of a batch do not share their noise


def test_joined_sets_keep_their_scenes() -> None:
    first, second = pack_views(scenes(2)), pack_views(scenes(3)[2:])
    both = joined([first, second])
    assert both.scenes == 3 and np.array_equal(both.depth_m[2], second.depth_m[0], equal_nan=True)
    patch = Patch(0, 0, 0, 20, 3, seed=4)
    alone = sense_patches(second, SENSOR, [patch], size=(12, 10)).counts
    assert torch.equal(sense_patches(both, SENSOR, [patch._replace(scene=2)], size=(12, 10)).counts, alone)
    with pytest.raises(InputError, match="cannot be joined"):
        joined([first, pack_views(scenes(1, height=8))])


def test_refusals_name_the_patch_and_the_scene() -> None:
    transients = scenes()
    resident = DevicePatches(pack_views(transients), SENSOR, "cpu")
    with pytest.raises(InputError, match="patch of 4 x 4 at scene 0, row 9, column 0 is outside 3 scenes of 12 x 10"):
        resident.sense([Patch(0, 9, 0, 1, 1, 0)], size=(4, 4), seed=0)
    packed = pack_views(transients)
    dark = replace(packed, radiance=np.zeros_like(packed.radiance))
    with pytest.raises(InputError, match="scene 1: no light returns, 3 signal photons cannot be had"):
        DevicePatches(dark, SENSOR, "cpu").sense([Patch(1, 0, 0, 3, 1, 0)], size=(4, 4), seed=0)
