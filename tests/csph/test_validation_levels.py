"""Photon levels of validation views, and delays that leave something to train on."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from test_training import FEW, MODEL, SMALL, near_planes

from csph.evaluation.metrics import PHOTON_LEVELS
from csph.training.config import preset
from csph.training.data import Frames, SetData
from csph.training.levels import dealt_levels
from csph.training.loop import train
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
    """Of 16 levels, 768 views, each of the set at each level, saw the 8 even ones, and 18 views 13."""
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


def test_delays_leave_something_to_train_on(tmp_path):
    """Beyond the range there are no labels: such runs trained nothing, at a loss of 0."""
    views = near_planes(3)
    reach = SMALL.recorded_range_m
    nearest = min(float(np.nanmin(one.depth_m)) for one in views.transients)
    for offset in (reach, 30.0, -1.0):
        with pytest.raises(InputError, match=rf"time offset {offset:.4g} m, .* less than {reach:.4g} m, the range"):
            preset("smoke", MODEL, **FEW, time_offset_m=offset)
    config = preset("smoke", MODEL, **FEW, time_offset_m=reach - nearest + 1e-3)
    limit = (
        f"leaves nothing to train on, expected less than {reach - nearest:.4g} m .*less the nearest depth of the set"
    )
    with pytest.raises(InputError, match=limit):
        train(config, views, views, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    packed = [pack_views(views.transients)]
    SetData(packed, packed, replace(config, time_offset_m=reach - nearest - 1e-3))
