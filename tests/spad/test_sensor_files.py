"""Sensor files: round trips to the last bit, every preset by its data sheet, one line for every mistake in a file."""

import math
from dataclasses import fields, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.errors import InputError
from spad.sensor.budget import Optics
from spad.sensor.files import (
    DETECTOR,
    HISTOGRAM,
    OPTICS,
    TABLES,
    SensorFile,
    load_sensor,
    preset_files,
    read_sensor,
    sensor_from_tables,
    sensor_names,
    write_sensor,
)
from spad.sensor.files import ZONES as ZONE_KEYS
from spad.sensor.model import HOT_RATE_HZ, PRESETS, Sensor
from spad.sensor.pulse import Pulse, SampledPulse
from spad.sensor.quantities import UNITS, format_quantity, parse_quantity
from spad.sensor.toml import read_toml
from spad.sensor.zone_array import ZoneArray

PLAIN = """name = "mine"
[histogram]
bins = 128
bin_width = "91 ps"
[pulse]
fwhm = "200 ps"
"""
TWO_ZONES = "[zones]\ncentre_x = [0, 1]\ncentre_y = [0, 1]\nwidth = [1, 1]\nheight = [1]\n"
WIDE = Sensor(
    name="wide",
    bins=77,
    bin_width_s=9.1e-11 / 3,
    period_s=100 * (9.1e-11 / 3),
    exposure_s=1e-3,
    pulse=SampledPulse((0.1, 1 / 3, 2e-9, 7.0), 1.7e-11),
    jitter=Pulse(3.3e-11, 1e-10),
    dark_count_rate_hz=(1 / 3, 2e5),
    pde=0.123,
    hot_share=0.01,
    hot_rate_hz=1e4 / 7,
    dead_share=0.02,
    reset="free-running",
    dead_time_s=1.1e-8,
    crosstalk=0.003,
)

WHOLE = replace(
    WIDE,
    name="whole",
    hot_share=0.0,
    hot_rate_hz=0.0,
    dead_share=0.0,
    reset="synchronous",
    dead_time_s=0.0,
    crosstalk=0.0,
)
ZONES = ZoneArray(
    (-0.1, 0.1 / 3),
    (0.0, 0.2),
    (0.1, 0.2),
    (0.3, 0.4),
    gain=(1e9 / 7, 2.0),
    delay_s=(-1e-9 / 3, 1.2e-9),
    clock=(1.01, 1 / 1.01),
    chirp_hz=-5.4e6 / 7,
    background=(190.0, 0.0),
    crosstalk=1e-3,
    trials=(5e6, 4e6),
    recovery=0.7,
    compression=1.1,
    illumination_x=-0.02,
    illumination_y=0.1,
    curvature_x=25.0,
    curvature_y=14.5,
    baseline_m=(0.0, 0.003, -1e-4),
    aperture_m=3e-4,
)


@pytest.mark.parametrize("sensor", [*PRESETS.values(), WIDE, WHOLE], ids=lambda sensor: sensor.name)
@pytest.mark.parametrize("optics", [None, Optics(1e-9 / 3, 4e-4, 1.33, 2.55e-5, 0.7, 12.3, 9.4e-7)])
def test_a_sensor_comes_back_from_its_file_to_the_last_bit(sensor, optics, tmp_path):
    zones = None if sensor is WIDE or optics is not None else ZONES
    whole = SensorFile(sensor, optics, zones, 'all "fields"', {"histogram.bins": "a\nsheet"})
    assert read_sensor(write_sensor(whole, tmp_path / "s.toml")) == whole


def test_zones_of_which_some_never_saturate_come_back_from_their_file(tmp_path):
    whole = SensorFile(WHOLE, None, replace(ZONES, trials=(math.inf, 1e5)))
    assert read_sensor(write_sensor(whole, tmp_path / "s.toml")) == whole


@pytest.mark.parametrize("key", ["hot_fraction", "hot_rate", "dead_fraction", "reset", "dead_time", "crosstalk"])
def test_what_only_pixels_have_is_refused_beside_zones(key):
    keys = ("hot_fraction", "hot_rate") if key == "hot_fraction" else (key,)
    only = {DETECTOR[key].field: getattr(WIDE, DETECTOR[key].field) for key in keys}
    with pytest.raises(InputError, match=rf"zones and detector\.{key} do not go together: it is of pixels"):
        SensorFile(replace(WHOLE, **only), zones=ZONES)


def test_optics_are_refused_beside_zones():
    """A radiometric budget is of pixels: nothing would read them."""
    with pytest.raises(InputError, match="zones and optics do not go together: a radiometric budget is of pixels"):
        SensorFile(WHOLE, Optics(1e-9, 4e-4, 1.33, 2.55e-5), ZONES)


def test_presets_say_that_their_efficiency_holds_the_fill_factor():
    """A pixel's pitch is from pixel to pixel, so that only the efficiency can hold it."""
    for name, path in preset_files().items():
        found = read_sensor(path)
        source = found.sources.get("detector.pde", "")
        assert (found.sensor.pde == 1) or "fill factor" in source or "of the area that is active" in source, name


def test_numbers_that_no_float_holds_are_refused_in_tables_too():
    tables = {"name": "x", "histogram": {"bins": 8, "bin_width": "1 ns"}, "pulse": {"sigma": "1 ns"}}
    with pytest.raises(InputError, match=r"detector\.pde: a whole number of more than 308 digits"):
        sensor_from_tables(tables | {"detector": {"pde": 10**400}})


def test_every_field_of_a_sensor_has_a_key():
    keyed = {key.field for table in (HISTOGRAM, DETECTOR) for key in table.values()} | {
        "name",
        "pulse",
        "jitter",
        "tdc",
    }
    assert keyed == {field.name for field in fields(Sensor)}
    assert {key.field for key in OPTICS.values()} == {field.name for field in fields(Optics)}
    assert {key.field for key in ZONE_KEYS.values()} == {field.name for field in fields(ZoneArray)}


@settings(deadline=None, derandomize=True)
@given(st.floats(0, 1e20), st.sampled_from(sorted(UNITS)))
def test_a_quantity_comes_back_to_the_last_bit(value, dimension):
    assert parse_quantity(format_quantity(value, dimension), dimension, "x") == value


def test_micro_has_two_characters_and_counts_per_second_are_hertz():
    for micro in "u\u00b5\u03bc":
        assert parse_quantity(f"33 {micro}s", "time", "x") == 33e-6
        assert parse_quantity(f"2 {micro}m2", "area", "x") == 2e-12
    for unit, meant in (("cps", "Hz"), ("kcps", "kHz")):
        with pytest.raises(InputError, match=f"did you mean '{meant}'"):
            parse_quantity(f"100 {unit}", "rate", "x")


def test_a_hint_never_makes_mega_of_milli_and_both_are_read_as_rates():
    assert parse_quantity("100 mHz", "rate", "x") == 0.1 and parse_quantity("100 MHz", "rate", "x") == 1e8
    with pytest.raises(InputError, match="did you mean 'MHz' or 'mHz'"):
        parse_quantity("100 mhz", "rate", "x")
    for unit, dimension in (("MJ", "energy"), ("Ms", "time"), ("Mm", "length")):
        with pytest.raises(InputError) as refused:
            parse_quantity(f"1 {unit}", dimension, "x")
        assert "did you mean" not in str(refused.value)


def test_a_file_may_begin_with_a_mark_of_byte_order(tmp_path):
    (tmp_path / "s.toml").write_bytes(b"\xef\xbb\xbf" + PLAIN.encode())
    assert read_sensor(tmp_path / "s.toml").sensor.bins == 128


def test_hot_pixels_of_a_file_that_gives_their_share_alone_have_the_rate_of_the_option(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(PLAIN + "[detector]\nhot_fraction = 0.1\n")
    sensor = read_sensor(path).sensor
    assert sensor.hot_rate_hz == HOT_RATE_HZ
    assert sensor.dark_rate_map_hz(10, 10).mean() == pytest.approx(0.1 * HOT_RATE_HZ)
    assert read_sensor(write_sensor(SensorFile(sensor), tmp_path / "again.toml")).sensor == sensor
    path.write_text(PLAIN + '[detector]\nhot_fraction = 0.1\nhot_rate = "0 Hz"\n')
    with pytest.raises(InputError, match=r"sensor mine: hot_rate 0 with hot_fraction .*: hot pixels would be dark"):
        read_sensor(path)
    with pytest.raises(InputError, match="sensor reference: hot_rate_hz 0 with hot_share"):
        replace(Sensor(), hot_share=0.1)


@pytest.mark.parametrize("key", ["hot_fraction", "dead_fraction"])
def test_a_value_out_of_range_is_told_by_the_files_key(key, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(PLAIN + f"[detector]\n{key} = 2\n")
    with pytest.raises(InputError, match=rf"s.toml: sensor mine: {key} 2 is outside 0 to 1$"):
        read_sensor(path)


def test_a_width_is_read_as_sigma_or_as_full_width_at_half_maximum(tmp_path):
    (tmp_path / "s.toml").write_text(PLAIN)
    sensor = read_sensor(tmp_path / "s.toml").sensor
    assert sensor.pulse.fwhm_s == pytest.approx(200e-12) and sensor.bin_width_s == 91e-12
    assert sensor.period_s == 128 * 91e-12 and sensor.name == "mine"


@pytest.mark.parametrize("name", sorted(preset_files()))
def test_a_preset_states_the_source_of_every_number(name):
    found, tables = load_sensor(name), read_toml(preset_files()[name])
    numbers = {f"{table}.{key}" for table in TABLES if table in tables for key in tables[table]}
    assert found.sensor.name == name and numbers == {*found.sources} and found.description
    assert all(source.strip() for source in found.sources.values())
    assert math.isfinite(found.sensor.range_m)


def test_the_presets_that_were_there_keep_their_names_and_values():
    assert all(load_sensor(name).sensor == sensor for name, sensor in PRESETS.items())
    assert not {*PRESETS} & {*preset_files()} and sensor_names()[0] == "reference"


@pytest.mark.parametrize(
    ("old", "new", "meant"),
    [
        ("bin_width", "binwidth", "unknown key histogram.binwidth; did you mean 'bin_width'?"),
        ("[histogram]", "[histogramm]", "unknown key histogramm; did you mean 'histogram'?"),
        ('"91 ps"', '"91 mm"', "histogram.bin_width: '91 mm' has the unit mm, expected a time in s"),
        ('"91 ps"', '"91 pS"', "did you mean 'ps'?"),
        ('"91 ps"', '"91"', "'91' has no unit"),
        ('"91 ps"', "91e-12", "has no unit"),
        ('"91 ps"', '"-91 ps"', "histogram.bin_width: '-91 ps' is negative"),
        ('"91 ps"', '"inf ps"', "is not finite"),
        ('"91 ps"', '"1.2.3 ps"', "is no number with a unit"),
        ('"91 ps"', '"1e9999999999 ps"', "is no number with a unit"),
        ("bins = 128", "bins = 1" + 5000 * "0", "a whole number beyond the 64 bits that TOML has"),
        ("bins = 128", "bins = 0x1" + 5000 * "0", "histogram.bins: a whole number beyond the 64 bits"),
        ('"200 ps"', '"200 ps"\n[detector]\npde = 1' + 400 * "0", "detector.pde: a whole number beyond the 64 bits"),
        ('"200 ps"', '"200 ps"\n[jitter]\nfwhm = "0 ps"', "jitter: pulse sigma 0 s is outside (0, 1e-3)"),
        (
            'fwhm = "200 ps"',
            "samples = [1, 1" + 400 * "0" + ']\nstep = "9 ps"',
            "pulse.samples[1]: a whole number beyond",
        ),
        (
            '"200 ps"',
            '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, 1]\ntrials = [inf, nan]"),
            "trials[1]: nan is not finite",
        ),
        (
            '"200 ps"',
            '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, 1]\ntrials = [inf, -inf]"),
            "trials[1]: -inf is negative",
        ),
        ('"200 ps"', '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, 1]\ngain = [inf, 1]"), "gain[0]: inf is not finite"),
        ('"91 ps"', '"0 ps"', "bin width 0 s is outside"),
        ('bin_width = "91 ps"', "", "histogram.bin_width is missing"),
        ("bins = 128", "", "histogram.bins is missing"),
        ("bins = 128", "bins = 12.5", "histogram.bins: 12.5 is no whole number"),
        ("bins = 128", "bins = -4", "-4 bins is outside 1 to 65536"),
        ('name = "mine"', "", "name is missing"),
        ("[pulse]", "[jitter]", "table [pulse] is missing"),
        ('fwhm = "200 ps"', "", "pulse: expected one of sigma, fwhm, or samples with step, there are 0"),
        ('fwhm = "200 ps"', "samples = [1, 2]", "pulse.step is missing"),
        ('fwhm = "200 ps"', 'samples = [1, -2]\nstep = "9 ps"', "pulse.samples[1]: -2 is negative"),
        ('fwhm = "200 ps"', 'samples = 3\nstep = "9 ps"', "pulse.samples: expected a list"),
        ('"200 ps"', '"200 ps"\n[detector]\npde = 1.5', "PDE 1.5 is outside (0, 1]"),
        (
            '"200 ps"',
            '"200 ps"\n[detector]\nreset = "never"',
            "reset 'never' is unknown, expected one of synchronous, free-running",
        ),
        ('"200 ps"', '"200 ps"\n[optics]\nf_number = 2', "optics.pulse_energy, focal_length, pixel_pitch is missing"),
        ('"200 ps"', '"200 ps"\n[sources]\n"histogram.bin" = "x"', "did you mean 'histogram.bins'?"),
        ('name = "mine"', 'schema = "2.0"\nname = "mine"', "sensor file of schema 2.0, this program reads 1"),
        ('name = "mine"', "name = ", "is no TOML"),
        ('"200 ps"', '"200 ps"\n[zones]\nwidth = [1]', "zones.centre_x, centre_y, height is missing"),
        ('"200 ps"', '"200 ps"\n' + TWO_ZONES, "zones.height: 1 numbers for 2 zones"),
        ('"200 ps"', '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, -1]"), "zones.height[1]: -1 is negative"),
        (
            '"200 ps"',
            '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, 1]\ncrosstalk = 1.5"),
            "zones.crosstalk: 1.5 is outside",
        ),
        ('"200 ps"', '"200 ps"\n' + TWO_ZONES.replace("[1]", "[1, 1]\nbaseline = [3, 0, 0]"), "3 has no unit"),
    ],
)
def test_a_mistake_in_a_file_is_one_line_that_names_it(old, new, meant, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(PLAIN.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_sensor(path)
    assert str(caught.value).startswith(f"{path}: ") and meant in str(caught.value)


def test_a_name_that_is_none_lists_those_there_are(tmp_path):
    with pytest.raises(InputError, match="did you mean 'tmf8820'"):
        load_sensor("tmf820")
    with pytest.raises(InputError, match="file not found"):
        load_sensor(str(tmp_path / "none.toml"))
    with pytest.raises(InputError, match=r"must end in \.toml"):
        write_sensor(SensorFile(Sensor()), tmp_path / "s.txt")
