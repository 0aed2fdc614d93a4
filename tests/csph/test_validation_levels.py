"""Photon levels of validation views, and delays that leave something to train on."""

from collections import Counter

import numpy as np
import pytest
from test_training import FEW, MODEL, SMALL, near_planes

from csph.levels import PHOTON_LEVELS, dealt_levels
from csph.networks.config import preset
from csph.training.data import Frames, SetData
from scenes import InputError
from spad.detection.training_patches import PackedViews, pack_views

PLACES, VIEWS_EACH = 8, 6


@pytest.fixture(scope="module")
def rooms() -> PackedViews:
    """Views one after the other, six of each place."""
    return pack_views(near_planes(1).transients * (PLACES * VIEWS_EACH))


def levels_of(packed: PackedViews, views: int, source: int = 0) -> list[tuple[int, tuple[float, float]]]:
    config = preset("smoke", MODEL, **{**FEW, "levels": "continuous", "validation_views": views})
    frames = Frames(packed, config, source=source)
    patches = [frames[i].patch for i in range(len(frames))]
    return [(patch.scene, (patch.signal, patch.background)) for patch in patches]


@pytest.mark.parametrize("views", [5, 8, 16, 18, 24, 48, 50, 96, 768])
def test_every_level_is_seen_as_often_as_the_number_of_views_allows(rooms, views):
    """Count each level: of 16, 768 views, each of the set at each level, saw the 8 even ones, and 18 views 13."""
    seen = Counter(level for _, level in levels_of(rooms, views))
    assert sum(seen.values()) == views and len(seen) == min(views, 16)
    assert max(seen.values()) - min(seen.values()) <= 1
    assert levels_of(rooms, views) == levels_of(rooms, views)


def test_no_level_goes_with_a_camera_or_a_place(rooms):
    """Every place, and the views of each number within one, see most levels: the same number of levels in steps of the
    views, or every level once, would tie them."""
    pairs = levels_of(rooms, 16 * PLACES * VIEWS_EACH)
    assert len(set(pairs)) == len(pairs)  # every view at every level, once
    pairs = levels_of(rooms, 4 * PLACES * VIEWS_EACH)
    for of in (lambda scene: scene // VIEWS_EACH, lambda scene: scene % VIEWS_EACH):
        seen = {key: {level for scene, level in pairs if of(scene) == key} for key in {of(scene) for scene, _ in pairs}}
        assert min(map(len, seen.values())) >= 10, seen


def test_several_sets_of_few_views_see_different_levels(rooms):
    together = [level for source in range(4) for _, level in levels_of(rooms, 4, source)]
    assert sorted(together) == sorted(PHOTON_LEVELS)
    assert dealt_levels(PHOTON_LEVELS, 40)[7:30] == dealt_levels(PHOTON_LEVELS, 23, 7)


def test_delays_that_leave_no_label_are_told(caplog):
    """Delays are drawn from 0 to the offset: what most of them move beyond the range trains nothing."""
    views, reach = near_planes(3), SMALL.recorded_range_m
    for offset in (2.01 * reach, -1.0):
        with pytest.raises(
            InputError, match=rf"time offset {offset:.6g} m, expected from 0 to {2 * reach:.4g} m, twice"
        ):
            preset("smoke", MODEL, **FEW, time_offset_m=offset)
    packed = [pack_views(views.transients)]
    nearest = float(np.nanmin(packed[0].depth_m))
    for offset, warned in ((reach - nearest - 1e-3, []), (2 * (reach - nearest), ["50 %"])):
        caplog.clear()
        with caplog.at_level("WARNING", logger="csph"):
            SetData(packed, packed, preset("smoke", MODEL, **FEW, time_offset_m=offset))
        messages = [record.getMessage() for record in caplog.records]
        assert len(messages) == len(warned) and all(part in line for part, line in zip(warned, messages, strict=True))
