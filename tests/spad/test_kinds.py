"""Values of another kind than a number of its unit are refused in one line that names them."""

from dataclasses import replace

import numpy as np
import pytest

from render.transient import write_transient
from scenes.errors import InputError
from spad.detection.detect import sense
from spad.formats.rgbd import transient_from_rgbd
from spad.measurements.histogram import write_histogram
from spad.sensor.budget import Optics
from spad.sensor.files import load_sensor
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse, SampledPulse, read_pulse
from spad.sensor.tdc import Tdc
from spad.sensor_names import sensor_by_name

ONES = np.ones((2, 2))
WALL = transient_from_rgbd(ONES, ONES, ONES)
LENS = (1e-9, 1e-2, 2.0, 2e-5)


@pytest.mark.parametrize(
    ("make", "meant"),
    [
        (lambda: Pulse("300 ps"), "pulse: sigma_s '300 ps', expected a number"),
        (lambda: Pulse(1e-10, None), "pulse: tail_s None, expected a number"),
        (lambda: SampledPulse((1.0, 2.0), "50 ps"), "measured pulse: sample_s '50 ps', expected a number"),
        (lambda: SampledPulse((1.0, "2"), 1e-11), "measured pulse: samples[1] '2', expected a number"),
        (lambda: SampledPulse("12", 1e-11), "measured pulse: samples '12', expected a list of numbers"),
        (lambda: SampledPulse(None, 1e-11), "measured pulse: samples None, expected a list of numbers"),
        (lambda: read_pulse("p.npy", "50 ps"), "p.npy: sample_s '50 ps', expected a number"),
        (lambda: Optics("1 nJ", 1, 1, 1), "optics: pulse_energy_j '1 nJ', expected a number"),
        (lambda: Optics(*LENS, transmission="80%"), "optics: transmission '80%', expected a number"),
        (lambda: Optics(*LENS, wavelength_m=None), "optics: wavelength_m None, expected a number"),
        (lambda: Optics(*LENS).budget(WALL, "reference"), "budget: sensor: expected a Sensor (`sensor_by_name` gives"),
        (lambda: Optics(*LENS).budget(ONES, Sensor()), "budget: expected a Transient of `render`"),
        (lambda: Tdc("2.5 ns", codes=4), "tdc: clock_period_s '2.5 ns', expected a number"),
        (lambda: Tdc(2.5e-9, codes=4.0), "tdc: codes 4.0, expected a whole number"),
        (lambda: Tdc(2.5e-9, table=3), "tdc: table 3, expected text"),
        (lambda: Tdc(2.5e-9, codes=4, correction_bits="7"), "tdc: correction_bits '7', expected a whole number"),
        (lambda: transient_from_rgbd(ONES, ONES, ONES, fov_deg="3"), "RGB-D images: fov_deg '3', expected a number"),
        (lambda: transient_from_rgbd(ONES, ONES, ONES, block=2.0), "RGB-D images: block 2.0, expected a whole number"),
        (lambda: transient_from_rgbd("a", ONES, ONES), "RGB-D images: not an array of numbers"),
        (lambda: transient_from_rgbd([[1], [1, 2]], ONES, ONES), "RGB-D images: not an array of numbers"),
    ],
)
def test_a_value_of_another_kind_is_refused_in_one_line(make, meant):
    with pytest.raises(InputError) as refused:
        make()
    assert str(refused.value).startswith(meant)


def test_numbers_of_numpy_are_numbers():
    assert Pulse(np.float64(1e-10)) == Pulse(1e-10) and type(Pulse(np.float32(1e-10)).sigma_s) is float
    assert SampledPulse(np.array([1, 2]), np.float64(1e-11)) == SampledPulse((1.0, 2.0), 1e-11)
    assert Tdc(2.5e-9, codes=np.int64(4)) == Tdc(2.5e-9, codes=4) and Optics(*np.array(LENS)) == Optics(*LENS)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"counts": None}, "histogram: counts: expected a ndarray, not NoneType"),
        ({"counts": [[[1]]]}, "histogram: counts: expected a ndarray, not list"),
        ({"sensor": "pf32"}, "histogram: sensor: expected a Sensor, not str"),
        ({"budget": (1, 2)}, "histogram: budget: expected a PhotonBudget, not tuple"),
        ({"mixed": None}, "histogram: mixed: expected a ndarray, not NoneType"),
        ({"meta": None}, "histogram: meta: expected a dict, not NoneType"),
    ],
)
def test_fields_of_a_histogram_are_of_their_kind(changed, message):
    histogram = sense(WALL, Sensor(), PhotonBudget(5, 5), seed=0)
    with pytest.raises(InputError, match=f"^{message}$"):
        replace(histogram, **changed)


@pytest.mark.parametrize("kind", [np.int64, np.float64, np.uint8])
def test_truth_of_a_histogram_has_one_type(kind):
    """Numbers are converted, and judged afterwards; what stands for truth values and is none is refused."""
    histogram = sense(WALL, Sensor(), PhotonBudget(5, 5), seed=0)
    given = np.full(histogram.depth_m.shape, 2, kind)
    for name, held in (("depth_m", np.float32), ("albedo", np.float16), ("expected_signal", np.float32)):
        found = getattr(replace(histogram, **{name: given}), name)
        assert found.dtype == held and (found == 2).all() and not found.flags.writeable
    assert given.flags.writeable
    with pytest.raises(InputError, match=rf"^histogram: mixed is {np.dtype(kind)}, expected bool$"):
        replace(histogram, mixed=given // 2)
    for bad in (given.astype(float) - 3, given.astype(int) - 3, given.astype(float) * 1e300):
        with pytest.raises(InputError, match=r"^histogram: depth_m holds infinite or negative values$"):
            replace(histogram, depth_m=bad)
    with pytest.raises(InputError, match=r"^histogram: depth_m is complex128, expected float32$"):
        replace(histogram, depth_m=given.astype(complex))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"meta": None}, "transient: meta: expected a dict, not NoneType"),
        ({"offsets": None}, "transient: offsets: expected a ndarray, not NoneType"),
        ({"mixed": [[True]]}, "transient: mixed: expected a ndarray, not list"),
        ({"width": 2.0}, "transient: width 2.0, expected a whole number"),
    ],
)
def test_fields_of_a_transient_are_of_their_kind(changed, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        replace(WALL, **changed)


def test_files_have_the_endings_that_readers_know(tmp_path):
    with pytest.raises(InputError, match=r"w\.png: a transient ends in \.exr$"):
        write_transient(WALL, tmp_path / "w.png")
    with pytest.raises(InputError, match=r"w\.txt: a histogram ends in \.h5$"):
        write_histogram(sense(WALL, Sensor(), PhotonBudget(5, 5), seed=0), tmp_path / "w.txt")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["pf32", "reference-tdc", "reference"])
def test_sensors_of_the_packages_files_have_names(name):
    assert sensor_by_name(name) == load_sensor(name).sensor


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (None, "sensor None, expected the name of one"),
        ([], r"sensor \[\], expected the name of one"),
        ("pf33", "sensor 'pf33' is unknown; did you mean 'pf32'.*expected one of reference, .*pf32"),
        ("tmf8820", "sensor tmf8820 has zones, expected one of pixels"),
        ("../x.toml", "sensor '../x.toml' is unknown"),
    ],
)
def test_what_names_no_sensor_of_pixels_is_refused(name, message):
    with pytest.raises(InputError, match=f"^{message}"):
        sensor_by_name(name)
