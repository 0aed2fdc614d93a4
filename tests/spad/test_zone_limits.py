"""Numbers of zones that nobody means are refused by key and zone; counts that no histogram holds, by zone."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.errors import InputError
from spad.detection.saturation import draw_saturated
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.files import SensorFile, sensor_from_tables
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.zone_array import ZoneArray
from spad.zones.histogram import sense_zones
from spad.zones.simulation import ZoneReturns, draw_zone_counts, zone_signal

SENSOR = Sensor(name="s", bins=64, bin_width_s=1e-10, pulse=Pulse(1e-10))
TWO = ZoneArray((-0.1, 0.1), (0.0, 0.0), (0.2, 0.2), (0.2, 0.2))
LIGHT = [ZoneReturns(np.array([0.3]), np.array([0.31]), np.array([1.0]))] * 2
TABLES = {"name": "x", "histogram": {"bins": 64, "bin_width": "100 ps"}, "pulse": {"sigma": "100 ps"}}
FILE_ZONES = {"centre_x": [-0.1, 0.1], "centre_y": [0.0, 0.0], "width": [0.2, 0.2], "height": [0.2, 0.2]}


@pytest.mark.parametrize(
    ("key", "value", "meant"),
    [
        ("width", [0.2, 0], "zones.width[1]: 0 is outside (0, 4]"),
        ("width", [12, 12], "zones.width[0]: 12 is outside (0, 4], tangents of angles and not degrees"),
        ("centre_y", [0, -6], "zones.centre_y[1]: -6 is outside [-4, 4], tangents of angles and not degrees"),
        ("delay", ["1 ns"], "zones.delay: 1 numbers for 2 zones"),
        ("delay", ["1 ns", "2 s"], "zones.delay[1]: 2 is outside [-1, 1]"),
        ("skew", ["1 ps", "1 ms"], "zones.skew[1]: 0.001 s is above the laser's period of 6.4e-09 s"),
        ("clock", [1e-9, 1], "zones.clock[0]: 1e-09 is outside [0.5, 2]"),
        ("gain", [1, 1e31], "zones.gain[1]: 1e+31 is outside [0, 1e+30]"),
        ("baseline", ["1 mm"], "zones.baseline: 1 numbers for x, y and z"),
    ],
)
def test_a_number_of_zones_out_of_range_is_refused_by_key_and_zone(key, value, meant):
    with pytest.raises(InputError) as refused:
        sensor_from_tables(TABLES | {"zones": FILE_ZONES | {key: value}})
    assert str(refused.value) == meant


@pytest.mark.parametrize(
    "bad", [{"width": ("a", 1.0)}, {"gain": "12"}, {"skew_s": (None, 0.0)}, {"aperture_m": "1 mm"}]
)
def test_values_that_are_no_numbers_are_refused_by_key(bad):
    (name,) = bad
    with pytest.raises(InputError, match=rf"^zones\.{name.split('_')[0]}.* expected a"):
        replace(TWO, **bad)


def test_a_skew_beyond_the_period_is_refused_where_light_is_binned_and_one_period_is_not():
    wide = replace(TWO, skew_s=(0.0, SENSOR.period_s))
    assert SensorFile(SENSOR, zones=wide).zones == wide
    assert zone_signal(LIGHT, SENSOR, wide).sum(axis=1) == pytest.approx([1, 1])
    with pytest.raises(InputError, match=r"zones\.skew\[1\]: 0\.001 s is above"):
        zone_signal(LIGHT, SENSOR, replace(TWO, skew_s=(0.0, 1e-3)))


@pytest.mark.parametrize("gain", [2.2e9, 5e9, 8e9, 1e30])
def test_a_zone_of_more_counts_than_a_histogram_holds_is_refused_by_its_number(gain):
    """Counts of 5e9 and 8e9 came out modulo 2^32, and 1e30 ended in a traceback."""
    with pytest.raises(InputError, match=r"zone 1 \(of 0 to 1\) has .* expected counts .* the limit is 2147483647"):
        draw_zone_counts(LIGHT, SENSOR, replace(TWO, gain=(1.0, gain)))
    plane = np.full((16, 16), 0.3)
    transient = transient_from_rgbd(plane, plane, plane, meta={"camera": {"fov_deg": 40.0}})
    with pytest.raises(InputError, match="the limit is 2147483647"):
        sense_zones(transient, SENSOR, replace(TWO, gain=(1.0, gain), leak=(1.0, 1.0)))


def test_counts_below_the_limit_are_what_was_expected():
    counts = draw_zone_counts(LIGHT, SENSOR, replace(TWO, gain=(1.0, 2e9)))
    assert abs(counts[1].sum() - 2e9) < 5 * np.sqrt(2e9)


def test_endless_many_and_more_trials_than_64_bits_count_draw_as_none_lost():
    flux, none = np.full((3, 8), 50.0), np.zeros(3)
    drawn = [
        draw_saturated(flux, np.full(3, trials), none, np.random.default_rng(1)) for trials in (np.inf, 1e16, 1e25)
    ]
    assert (drawn[0] == drawn[1]).all() and (drawn[0] == drawn[2]).all()
