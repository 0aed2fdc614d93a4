"""Bistatic geometry: the ellipsoid both ways, arrival times within the period, and zones beside their emitter."""

import math
from dataclasses import replace

import numpy as np
import pytest

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from scenes.model import Camera
from spad.estimators.bistatic import (
    optical_path_m,
    radial_depth_m,
    radial_depth_of,
    recorded_range_m,
    time_tells_depth,
    true_arrival_s,
    true_path_m,
)
from spad.estimators.depth import confidence_map, histogram_depth_m, histogram_errors
from spad.formats.rgbd import transient_from_rgbd
from spad.measurements.histogram import Histogram
from spad.sensor.clock import chirped, unchirped
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.zone_array import ZoneArray
from spad.zones.histogram import sense_zones

GATED = Sensor(name="gated", bins=64, bin_width_s=1e-10, period_s=2e-8)
BASELINE = (0.4, -0.2, 0.1)


def histogram_of(depth_m: np.ndarray, sensor: Sensor, baseline_m=(0.0, 0.0, 0.0), height: int | None = None):
    rows, columns = depth_m.shape
    camera = {"pose": np.eye(4).tolist(), "fov_deg": 50.0, "width": columns, "height": height or rows}
    counts = Histogram.from_counts(np.zeros((rows, columns, sensor.bins), int), sensor)
    meta = {"transient": {"camera": camera, "laser": {"mode": "flood", "baseline_m": list(baseline_m)}}}
    return replace(counts, depth_m=depth_m.astype(np.float32), meta=meta)


def test_path_and_depth_are_inverse():
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth = rng.uniform(0.01, 20, 500)
    path = optical_path_m(depth, directions, BASELINE)
    assert (path >= np.linalg.norm(BASELINE)).all(), "the triangle inequality"
    assert radial_depth_m(path / 2, directions, BASELINE) == pytest.approx(depth, rel=1e-5, abs=1e-6)
    assert optical_path_m(depth, directions, (0, 0, 0)) == pytest.approx(2 * depth)


def test_arrival_is_by_both_legs_and_wraps_at_the_period():
    """The record covers 6.4 of 20 ns: 1 m arrives after it, 3.1 m wraps to its beginning."""
    depth = np.array([[0.5, 1.0], [3.1, np.nan]])
    arrival = true_arrival_s(histogram_of(depth, GATED))
    assert arrival[0] == pytest.approx([1.0 / C, 2.0 / C])
    assert arrival[1, 0] == pytest.approx(6.2 / C - GATED.period_s) and math.isnan(arrival[1, 1])
    record_s = GATED.bins * GATED.bin_width_s
    assert arrival[0, 0] < record_s <= arrival[0, 1]

    beside = histogram_of(depth, GATED, BASELINE)
    rays = Camera(np.eye(4), 50.0, 2, 2).rays() @ Camera(np.eye(4), 50.0, 2, 2).rotation
    legs = depth[0] + np.linalg.norm(depth[0][:, None] * rays[0] - BASELINE, axis=-1)
    assert true_arrival_s(beside)[0] == pytest.approx(legs / C)


def test_unknown_rays_beside_a_displaced_laser():
    """A histogram that is not of its camera's image has no arrival to draw, and its depth is refused, not made up."""
    cropped = histogram_of(np.ones((2, 2)), GATED, BASELINE, height=4)
    assert np.isnan(true_path_m(cropped)).all()
    with pytest.raises(InputError, match="where its pixels look"):
        histogram_depth_m(cropped)
    assert np.isfinite(true_path_m(replace(cropped, meta={}))).all(), "a laser that nobody told of is at the camera"


def plane(depth_m: float, baseline_m=(0.0, 0.0, 0.0), pixels: int = 120) -> Transient:
    """A frontal plane, a return a pixel, in a camera of 60 degrees that states no more than that."""
    camera = Camera(np.eye(4), 60.0, pixels, pixels)
    rays = camera.rays() @ camera.rotation
    depth = depth_m / rays[..., 2]
    ones = np.ones((pixels, pixels))
    flat = transient_from_rgbd(depth.astype(np.float32), ones, 0 * ones, fov_deg=60.0)
    path = optical_path_m(depth, rays, baseline_m).ravel().astype(np.float32)
    laser = {"mode": "flood", "baseline_m": list(baseline_m), "cone_deg": None}
    return replace(flat, path_near_m=path, path_far_m=path, meta={"camera": {"fov_deg": 60.0}, "laser": laser})


NARROW = ZoneArray((-0.3, 0.3), (0.2, 0.2), (0.02, 0.02), (0.02, 0.02), gain=(1e9, 1e9))
ZONED = Sensor(name="s", bins=256, bin_width_s=1e-10, pulse=Pulse(3e-10))


def test_depth_of_zones_beside_their_emitter():
    """Narrow zones of a plane: the zones' centres, not the image's pixels, tell depth from half the path."""
    baseline = (0.1, 0.05, 0.0)
    histogram = sense_zones(plane(1.5, baseline), ZONED, replace(NARROW, baseline_m=baseline), seed=1)
    assert histogram.counts.sum() > 1000
    error = histogram_depth_m(histogram) - histogram.depth_m
    assert np.abs(error).max() < 0.01
    ray = np.stack((np.array(NARROW.centre_x), np.array(NARROW.centre_y), np.ones(2)), axis=-1)[None]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    legs = histogram.depth_m + np.linalg.norm(histogram.depth_m[..., None] * ray - baseline, axis=-1)
    assert true_arrival_s(histogram) == pytest.approx(legs / C)


@pytest.mark.parametrize(
    "converters",
    [
        {"delay_s": (1.2e-9, -3e-10)},
        {"delay_s": (2e-8, -1e-7)},
        {"clock": (1.02, 0.98)},
        {"chirp_hz": 4e5},
        {"chirp_hz": -4e5},
    ],
)
def test_depth_of_zones_whose_converters_measure_other_times(converters):
    """A delay of 1.2 ns alone would be 18 cm."""
    histogram = sense_zones(plane(1.5), ZONED, replace(NARROW, **converters), seed=1)
    assert np.abs(histogram_depth_m(histogram) - histogram.depth_m).max() < 5e-3
    centroid_s = ZONED.bin_width_s * (histogram.counts @ (np.arange(256) + 0.5)) / histogram.counts.sum(axis=2)
    assert np.abs(true_arrival_s(histogram) - centroid_s).max() < 3e-11
    assert (recorded_range_m(histogram) == ZONED.range_m).all(), "its bins cover the period"
    assert not time_tells_depth(histogram) and confidence_map(histogram, histogram.depth_m) is None
    assert time_tells_depth(sense_zones(plane(1.5), ZONED, NARROW, seed=1))


def test_a_delay_takes_from_the_record_of_zones():
    """6.4 of 20 ns are recorded, of which a delay takes 1.2."""
    gated = replace(ZONED, bins=64, period_s=2e-8)
    histogram = sense_zones(plane(0.5), gated, replace(NARROW, delay_s=(1.2e-9, 0.0)), seed=1)
    assert recorded_range_m(histogram)[0] == pytest.approx(np.array([5.2e-9, 6.4e-9]) * C / 2)


@pytest.mark.parametrize("delay_s", [9e-9, -3e-9, 2e-9])
def test_beyond_range_counts_the_zones_whose_return_a_delay_moves_out_of_the_record(delay_s):
    """6.4 of 20 ns are recorded. Light of two zones takes 2 and 5 ns; a third gets there late enough to wrap."""
    gated = replace(ZONED, bins=64, period_s=2e-8)
    time_s = np.array([[2e-9, 5e-9, 13e-9]])
    zones = {"clock": np.ones((1, 3)), "delay_s": np.full((1, 3), delay_s), "chirp_hz": 0.0}
    histogram = replace(histogram_of(time_s * C / 2, gated), meta={"zones": zones})
    held = (time_s + delay_s) % gated.period_s < gated.bins * gated.bin_width_s
    errors = histogram_errors(histogram.depth_m, histogram)
    assert (errors["pixels"], errors["beyond_range"]) == (held.sum(), (~held).sum())


@pytest.mark.parametrize("period_bins", [64, 70, 75, 200])
def test_a_delay_of_nearly_nothing_moves_no_depth_and_no_range(period_bins):
    """The pulse reaches 2.1 ns. Behind the record the period goes on for 0, 0.6, 1.1 and 13.6 ns."""
    sensor = replace(GATED, period_s=period_bins * GATED.bin_width_s, pulse=Pulse(3e-10))
    depth = np.linspace(0, sensor.recorded_range_m, 501)[None].astype(np.float32)
    for delay_s in (1e-15, -1e-15):
        zones = {"clock": np.ones((1, 501)), "delay_s": np.full((1, 501), delay_s), "chirp_hz": 0.0}
        histogram = replace(histogram_of(np.full((1, 501), 0.5), sensor), meta={"zones": zones})
        assert radial_depth_of(histogram, depth) == pytest.approx(depth, abs=1e-5)
        assert recorded_range_m(histogram) == pytest.approx(sensor.recorded_range_m, abs=1e-5)


@pytest.mark.parametrize("period_bins", [70, 200])
def test_noise_just_before_the_emission_is_depth_0_where_no_bin_records_so_late(period_bins):
    """A delay of 0.5 ns in a record of 6.4 ns: its first 0.5 ns are before the emission, its end is not."""
    sensor = replace(GATED, period_s=period_bins * GATED.bin_width_s, pulse=Pulse(3e-10))
    recorded_s = np.array([[0.0, 3e-10, 7e-10, 6.4e-9]])
    zones = {"clock": np.ones((1, 4)), "delay_s": np.full((1, 4), 5e-10), "chirp_hz": 0.0}
    histogram = replace(histogram_of(np.ones((1, 4)), sensor), meta={"zones": zones})
    found_s = radial_depth_of(histogram, recorded_s * C / 2) * 2 / C
    assert found_s[0] == pytest.approx([0, 0, 2e-10, 5.9e-9])


def test_zones_find_the_last_part_of_a_range_that_their_bins_cover():
    """A plane at 3.6 of 3.84 m: its return lies within the pulse's reach of the period's end."""
    histogram = sense_zones(plane(3.6), ZONED, replace(NARROW, gain=(1e10, 1e10), delay_s=(1e-15, 5e-10)), seed=1)
    assert histogram.depth_m.max() < 3.84 and histogram_errors(histogram_depth_m(histogram), histogram)["mae_mm"] < 10


def test_clocks_run_back_as_they_ran():
    time = np.linspace(0, 2, 50)
    for chirp in (0.0, 0.3, -0.2):
        assert unchirped(chirped(time, chirp), chirp) == pytest.approx(time, abs=1e-7)
    assert unchirped(chirped(time, -0.5), -0.5).max() == pytest.approx(1.0), "it stood still from 1 on"
