"""Calibration: the fit's model is the sensor's, and simulated captures give back the truth within its own errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scenes.errors import InputError
from spad.detection.saturation import draw_saturated
from spad.sensor.files import SensorFile
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.zone_array import ZoneArray, check_times, largest_chirp
from spad.zones.calibration import (
    Calibration,
    as_sensor,
    calibrate,
    calibrated_file,
    check_returns,
    middle_capture,
    natural,
    poisson_deviance,
    sees_return,
    standard_errors,
)
from spad.zones.expected_counts import PulseBasis, ZoneCapture, ZoneModel
from spad.zones.fit import fit, roughness
from spad.zones.simulation import ZoneReturns, draw_zone_counts, expected_zone_counts, zone_flux

ZONES = ZoneArray((-0.2, 0.0, 0.2), (0.0, 0.0, 0.0), (0.1,) * 3, (0.1,) * 3)
SENSOR = Sensor(name="s", bins=40, bin_width_s=1e-10, pulse=Pulse(1e-10))
FREE = (
    "pulse", "gain", "delay", "skew", "clock", "bin_width", "chirp", "background", "leak", "echo", "trials", "recovery",
)  # fmt: skip
NATURAL = (
    "gain", "delay_s", "skew_s", "clock", "bin_width_s", "chirp_hz", "background", "leak", "echo_m2", "trials",
    "recovery",
)  # fmt: skip


def light(distance_m: float) -> list[ZoneReturns]:
    """Three zones that see paths of a few interval lengths, falling with the square of the distance."""
    near = 2 * distance_m * np.linspace(1, 1.05, 7)
    return [
        ZoneReturns(near * stretch, near * stretch * 1.01, np.full(7, 0.1 / distance_m**2))
        for stretch in (1, 1.02, 1.04)
    ]


def truth() -> tuple[ZoneModel, dict[str, np.ndarray]]:
    basis = PulseBasis.made(6, 3, 4)
    steps = np.arange(basis.matrix.shape[1])
    pulse = 6000 * (np.exp(-(((steps - 8) / 4) ** 2)) + 0.3)
    one = np.ones(1)
    return ZoneModel(basis, SENSOR.bins, 3, 1), {
        "pulse": pulse,
        "gain": np.array([0.6, 1.0, 1.4]),
        "delay": np.array([0.4, 0.0, -0.3]),
        "skew": np.array([0.81, 0.0, 1.69]),
        "clock": np.array([1.01, 1.0, 0.99]),
        "bin_width": 1e-10 * one,
        "chirp": -6e-4 * one,
        "background": np.array([600.0, 800.0, 500.0]),
        "leak": np.array([0.2, 0.1, 0.3]),
        "echo": np.array([1e-4, 2e-4, 0.5e-4]),
        "trials": np.array([3e7, 4e7, 5e7]),
        "recovery": np.array([0.8, 0.6, 0.9]),
        "compression": np.zeros(3),
        "crosstalk": 0.0 * one,
    }


def captures(model: ZoneModel, values: dict, number: int, seed: int) -> list[ZoneCapture]:
    rng, found = np.random.default_rng(seed), []
    sensor, zones = as_sensor(model, values, SENSOR, ZONES)
    for distance in np.linspace(0.1, 0.3, number):
        returns = light(distance)
        flux = zone_flux(returns, sensor, zones)
        found.append(ZoneCapture(returns, draw_saturated(flux, *zones.saturation[:2], rng)))
    return found


def test_the_fits_model_is_the_sensors():
    """Two routes to expected counts: linear in the pulse's steps, and pulse by pulse over each return's interval."""
    model, values = truth()
    values["crosstalk"], values["compression"] = np.array([0.01]), np.array([0.7, 0.0, 1.2])
    sensor, zones = as_sensor(model, values, SENSOR, ZONES)
    leak = values["leak"]
    for distance, drift in ((0.1, 0.0), (0.27, 3e-11), (0.59, 0.0)):  # light of the last one meets an emission
        values["leak"] = leak
        capture = ZoneCapture(light(distance), np.zeros((3, 40)), drift)
        direct = expected_zone_counts(capture.returns, sensor, zones, drift)
        # the module's own reflection has no length, in the fit a millionth of a step
        assert model.expected(values, capture) == pytest.approx(direct, rel=1e-6, abs=1e-6)
        values["leak"] = 0 * values["leak"]
        direct = expected_zone_counts(capture.returns, sensor, replace(zones, leak=()), drift)
        assert model.expected(values, capture) == pytest.approx(direct, rel=1e-9, abs=1e-6)


def test_the_file_states_the_calibration_as_source_of_what_was_fitted_alone():
    """State no source for what is off; keep the start's for a width of a bin that is the start's."""
    model, values = truth()
    calibrated = as_sensor(model, values, SENSOR, ZONES)
    before = {"histogram.bin_width": "maker", "zones.delay": "older", "zones.echo": "older", "zones.width": "drawing"}
    start = SensorFile(SENSOR, zones=ZONES, sources=before | {"pulse.sigma": "maker"})
    fitted = {"zones.gain": "now", "zones.delay": "now", "pulse.samples": "now", "pulse.step": "now"}
    for free, width in ((("delay",), "maker"), (("delay", "bin_width"), "now")):
        found = Calibration(*calibrated, {}, 1.0, values, model.basis, free)
        sources = calibrated_file(start, found, "mine", "now").sources
        assert sources == fitted | {"histogram.bin_width": width, "zones.width": "drawing"}


def test_the_jacobian_is_the_finite_difference():
    model, values = truth()
    values["crosstalk"], values["compression"] = np.array([0.01]), np.array([0.7, 0.0, 1.2])
    capture = ZoneCapture(light(0.17), np.zeros((3, 40)))
    names = model.parameter_names(values, (*FREE, "crosstalk", "compression"))
    _, slope = model.jacobian(values, capture, names)
    for column, (name, at) in enumerate(names):
        size = abs(values[name][at])
        step = 1e-5 * (size if name == "bin_width" else max(size, 0.1))
        pair = []
        for sign in (1, -1):
            moved = {key: value.copy() for key, value in values.items()}
            moved[name][at] += sign * step
            pair.append(model.expected(moved, capture))
        expected = (pair[0] - pair[1]) / (2 * step)
        assert np.abs(slope[:, :, column] - expected).max() < 2e-3 * np.abs(expected).max(), (name, at)


def repeated(repetitions: int) -> dict[str, float]:
    """Share of the fits whose 95 % interval holds the truth, by parameter, averaged over zones."""
    model, values = truth()
    right, inside = natural(model, values), {}
    for seed in range(repetitions):
        found, information, names = fit(model, captures(model, values, 8, seed), values, FREE, steps=8)
        errors, numbers = standard_errors(model, found, information, names), natural(model, found)
        for name in NATURAL:
            used = errors[name] > 0  # the gauge has none
            off = np.abs(numbers[name] - right[name])[used] / errors[name][used]
            inside.setdefault(name, []).append(float((off < 1.96).mean()))
    return {name: float(np.mean(fractions)) for name, fractions in inside.items()}


def test_a_calibration_of_simulated_captures_is_near_the_truth():
    assert min(repeated(6).values()) > 0.6


def test_zones_that_do_not_saturate_have_finite_standard_errors():
    model, values = truth()
    values |= {"trials": np.full(3, np.inf), "recovery": np.zeros(3)}
    names = [(name, at) for name in ("gain", "background") for at in range(3)]
    with np.errstate(invalid="raise"):
        errors = standard_errors(model, values, np.eye(len(names)), names)
    assert all(np.isfinite(error).all() for error in errors.values()) and (errors["trials"] == 0).all()


@pytest.mark.slow
def test_standard_errors_cover_the_truth():
    """200 repetitions. Saturation spreads counts a little less than Poisson does: intervals cover a little more."""
    covered = repeated(200)
    assert all(0.90 <= fraction <= 0.985 for fraction in covered.values()), covered
    assert 0.90 <= np.mean([*covered.values()]) <= 0.98


# A sensor whose pulse, skews and bin width a calibration has to find: zone 1, the gauge's, is not the narrowest.
BEFORE = Sensor(name="before", bins=64, bin_width_s=0.98e-10, pulse=Pulse(2e-10))
MADE = replace(
    ZONES,
    gain=(3e5, 5e5, 7e5),
    delay_s=(1.43e-9, 1.31e-9, 1.36e-9),
    skew_s=(0.0, 5e-11, 8e-11),
    clock=(1.01, 1.0, 0.99),
    background=(60.0, 80.0, 50.0),
    leak=(0.02, 0.01, 0.03),
    echo_m2=(1e-4, 2e-4, 0.5e-4),
    trials=(3e5, 4e5, 5e5),
    recovery=(0.8, 0.6, 0.9),
)
SKEWED, NARROW = Pulse(1.1e-10, 1.2e-10), Pulse(1e-10)


def calibrated_errors(pulse: Pulse, seed: int) -> tuple[dict[str, np.ndarray], float]:
    """Calibrate from BEFORE with captures drawn from MADE: errors over their standard errors by name, and deviance."""
    sensor, shown = replace(BEFORE, bin_width_s=1e-10, period_s=64e-10, pulse=pulse), []
    for number, distance in enumerate(np.linspace(0.1, 0.4, 16)):
        returns = light(distance)
        counts = draw_zone_counts(returns, sensor, MADE, seed=1000 * seed + number)
        shown.append(ZoneCapture(returns, counts))
    free = [name for name in FREE if name not in ("pulse", "gain")]
    found = calibrate(shown, BEFORE, ZONES, free=free, model_error=0.0)
    numbers = {name: np.array(getattr(found.zones, name)) for name in NATURAL if hasattr(MADE, name)}
    right = {name: np.array(getattr(MADE, name)) for name in numbers}
    numbers |= {"bin_width_s": np.array([found.sensor.bin_width_s])}
    right |= {"bin_width_s": np.array([1e-10])}
    off = {}
    for name, number in numbers.items():
        errors = np.atleast_1d(found.errors[name])
        off[name] = np.atleast_1d(number - right[name])[errors > 0] / errors[errors > 0]
    return off, found.deviance


@pytest.mark.parametrize("pulse", [NARROW, SKEWED], ids=["Gaussian", "Gaussian with a tail"])
def test_a_calibration_finds_a_pulse_that_it_did_not_begin_with(pulse):
    off, deviance = calibrated_errors(pulse, 0)
    assert max(float(np.abs(errors).max()) for errors in off.values()) < 4.5, off
    assert deviance == pytest.approx(1, abs=5 * math.sqrt(2 / (16 * 3 * 64)))


@pytest.mark.slow
@pytest.mark.parametrize("pulse", [NARROW, SKEWED], ids=["Gaussian", "Gaussian with a tail"])
def test_a_calibrations_intervals_cover_the_truth(pulse):
    """12 repetitions from another pulse, bin width and no skew: of 95 % intervals about 95 % hold the truth.

    Within a repetition errors go together, so that the share of one number spreads as that of 12 draws at the least;
    all numbers together by less than half of it. The root mean square of errors over standard errors spreads by 0.06 to
    0.1, and tells standard errors that are 1.5 times too large or too small.
    """
    off = [calibrated_errors(pulse, seed)[0] for seed in range(1, 13)]
    covered = {name: np.mean([np.abs(errors[name]) < 1.96 for errors in off]) for name in off[0]}
    draws = math.sqrt(0.95 * 0.05 / len(off))
    assert min(covered.values()) > 0.95 - 3.5 * draws, covered
    assert np.mean([*covered.values()]) == pytest.approx(0.95, abs=0.7 * draws), covered
    squares = [np.mean([np.mean(errors[name] ** 2) for errors in off]) for name in off[0]]
    assert math.sqrt(np.mean(squares)) == pytest.approx(1, abs=0.25), squares


def test_smoothing_leaves_gaussians_and_exponentials_alone():
    steps = np.arange(30.0)
    lengths = np.repeat([1, 3], 15)
    for pulse in (np.exp(-(((steps - 9) / 8) ** 2)), np.exp(-steps / 6)):
        assert np.abs(roughness(pulse * lengths, lengths)[0]).max() < 1e-3
    third, slope = roughness(np.random.default_rng(1).uniform(1, 2, 30), lengths)
    assert third.shape == (24,) and slope.shape == (24, 30) and np.abs(third).max() > 0.1


def test_the_slope_of_the_roughness_is_the_finite_difference():
    rng = np.random.default_rng(2)
    pulse, change, lengths = rng.uniform(1, 2, 20), rng.normal(size=20), np.repeat([1, 3], 10)
    pulse[4] = 3.0  # the peak, on which the floor hangs
    change[4] = 0.0
    pair = [roughness(pulse + sign * 1e-6 * change, lengths)[0] for sign in (1, -1)]
    assert roughness(pulse, lengths)[1] @ change == pytest.approx((pair[0] - pair[1]) / 2e-6, abs=1e-6)


def test_deviance_of_the_truth_is_one_a_bin():
    rng = np.random.default_rng(1)
    expected = rng.uniform(20, 5000, 20_000)
    assert poisson_deviance(rng.poisson(expected), expected) / 20_000 == pytest.approx(1, abs=5 * math.sqrt(2 / 20_000))
    assert poisson_deviance(np.zeros(3), np.ones(3)) == pytest.approx(6)


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(InputError, match="gravity cannot be fitted"):
        calibrate([], SENSOR, ZONES, free=("gravity",))
    with pytest.raises(InputError, match="0 captures, expected 8 or more"):
        calibrate([], SENSOR, ZONES)


@pytest.mark.parametrize("zone", [0, 1])  # one of them carries the gauge
@pytest.mark.parametrize(("background", "words"), [(0, "all its counts are 0"), (600, "background alone")])
def test_a_zone_that_sees_nothing_is_named(zone, background, words):
    shown = captures(*truth(), 8, 3)
    for number, capture in enumerate(shown):
        capture.counts[zone] = np.random.default_rng(number).poisson(background, SENSOR.bins)
    with pytest.raises(InputError, match=rf"zone {zone} \(of 0 to 2\) sees a return in 0 of 8 captures, .*{words}"):
        calibrate(shown, SENSOR, ZONES)


def test_a_fit_begins_with_a_capture_in_which_all_zones_see_a_return():
    shown = captures(*truth(), 8, 3)
    shown[4].counts[0] = shown[5].counts[2] = 0
    assert middle_capture(shown) is shown[3]
    assert np.isfinite(calibrate(shown, SENSOR, ZONES, free=("delay", "background")).deviance)
    shown = captures(*truth(), 8, 3)
    for number, capture in enumerate(shown):
        capture.counts[number % 3] = 0
    with pytest.raises(InputError, match="in none of 8 captures do all 3 zones see a return"):
        check_returns(np.array([capture.counts for capture in shown]))


@pytest.mark.parametrize("background", [0.02, 0.65, 3.0, 40.0])
def test_background_alone_is_no_return(background):
    counts = np.random.default_rng(1).poisson(background, (4000, 128))
    assert sees_return(counts).mean() < 2e-3
    counts[:, 60] += 12 + round(12 * math.sqrt(background))
    assert sees_return(counts).all()


def test_a_fit_with_numbers_at_their_bounds_reaches_the_optimum():
    """A true skew, leak and recovery of 0: from elsewhere the fit ends as near to the counts as the truth is."""
    model, values = truth()
    values |= {"skew": np.array([0.81, 0.0, 0.0]), "leak": np.zeros(3), "recovery": np.zeros(3)}
    shown = captures(model, values, 8, 3)
    start = {
        **values,
        "skew": np.array([0.0, 0.0, 0.0]),
        "gain": np.array([0.5, 1.0, 1.5]),
        "trials": 3 * values["trials"],
    }
    found, _, _ = fit(model, shown, start, FREE)
    deviance, best = (
        sum(poisson_deviance(one.counts, model.expected(at, one)) for one in shown) for at in (found, values)
    )
    assert deviance < best


def test_what_starts_at_0_is_fitted_where_the_captures_show_it():
    """Leaks and echoes start at 0, where a size that is relative to their own says nothing of them."""
    model, values = truth()
    shown = captures(model, values, 8, 5)
    start = {**values, "leak": np.zeros(3), "echo": np.zeros(3)}
    found, _, _ = fit(model, shown, start, FREE, steps=12)
    assert found["leak"] == pytest.approx(values["leak"], rel=0.3)
    assert found["echo"] == pytest.approx(values["echo"], rel=0.3)


def test_a_fitted_chirp_is_one_that_a_sensor_file_takes():
    """Two captures of nearly one distance leave the chirp free, and a step of 1e-3 a bin can run away with it."""
    model, values = truth()
    shown = captures(model, values, 40, 7)[:2]
    limit = largest_chirp(SENSOR.bins)
    for start in (0.9 * limit, -0.9 * limit):
        found, _, _ = fit(model, shown, {**values, "chirp": np.array([start])}, ("pulse", "gain", "delay", "chirp"))
        assert abs(found["chirp"][0]) <= limit
        check_times(*as_sensor(model, found, SENSOR, ZONES))


def test_a_chirp_beyond_its_limit_is_fitted_as_the_largest():
    model, values = truth()
    limit = largest_chirp(SENSOR.bins)
    wild = {**values, "chirp": np.array([-1.5 * limit])}
    shown = [ZoneCapture(one.returns, model.expected(wild, one)) for one in captures(model, values, 8, 7)]
    found, _, _ = fit(model, shown, {**values, "chirp": np.array([0.0])}, ("pulse", "gain", "chirp"), steps=80)
    assert found["chirp"][0] == pytest.approx(-limit, rel=1e-6)
    check_times(*as_sensor(model, found, SENSOR, ZONES))
