"""Multi-zone sensors: each effect against its own closed form or an event-by-event simulation, all off the identity."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from spad.detection.flux import interval_cdf
from spad.detection.saturation import draw_saturated, saturated, saturated_jacobian
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.clock import chirped
from spad.sensor.files import SensorFile
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse, SampledPulse
from spad.sensor.zone_array import EFFECTS, ZoneArray
from spad.zones.histogram import sense_zones, with_budget, zone_grid
from spad.zones.simulation import ZoneReturns, expected_zone_counts, zone_returns, zone_signal

SENSOR = Sensor(name="s", bins=64, bin_width_s=1e-10, pulse=Pulse(1e-10))
TWO = ZoneArray((-0.2, 0.2), (0.0, 0.0), (0.3, 0.3), (0.5, 0.5))


def view(depth_m: float = 0.3, pixels: int = 40, fov_deg: float = 60.0, baseline=(0.0, 0.0, 0.0)):
    """A frontal plane at `depth_m`, one return a pixel at its radial distance, radiance 1."""
    focal = pixels / 2 / math.tan(math.radians(fov_deg / 2))
    at = (np.arange(pixels) + 0.5 - pixels / 2) / focal
    x, y = np.meshgrid(at, at)
    radial = depth_m * np.sqrt(1 + x * x + y * y)
    path, shape = (2 * radial).astype(np.float32).ravel(), (pixels, pixels)
    return Transient(
        pixels,
        pixels,
        np.arange(pixels * pixels + 1, dtype=np.int64),
        path,
        path,
        np.ones(pixels * pixels, np.float32),
        np.ones(pixels * pixels, np.uint8),
        depth_m=radial.astype(np.float32),
        normal=np.zeros((*shape, 3), np.float16),
        albedo=np.ones(shape, np.float16),
        ambient=np.zeros(shape, np.float32),
        mixed=np.zeros(shape, bool),
        error=np.zeros(shape, np.float32),
        meta={"camera": {"fov_deg": fov_deg}, "laser": {"baseline_m": list(baseline)}},
    )


def test_with_all_effects_off_a_zone_is_the_sum_of_its_light():
    """The integral of cos^4 over the zone's tangents, by quadrature, and the pulses of a plain sensor."""
    found = zone_returns(view(pixels=200), TWO)
    grid = (np.arange(400) + 0.5) / 400
    x, y = np.meshgrid(-0.35 + 0.3 * grid, -0.25 + 0.5 * grid)
    expected = float(((1 + x * x + y * y) ** -2).mean()) * 0.15
    assert [returns.light.sum() for returns in found] == pytest.approx([expected] * 2, rel=1e-4)
    counts = expected_zone_counts(found, SENSOR, TWO)
    assert counts.sum(axis=1) == pytest.approx([expected] * 2, rel=1e-4)
    assert not any(effect_changes(TWO, effect) for effect in EFFECTS)


def effect_changes(zones: ZoneArray, effect: str) -> bool:
    return zones.without(effect) != zones


def test_every_effect_can_be_switched_off_alone():
    on = replace(
        TWO,
        gain=(2.0, 3.0),
        delay_s=(1e-10, 3e-10),
        skew_s=(1e-10, 0.0),
        leak=(0.1, 0.0),
        echo_m2=(0.0, 1e-4),
        chirp_hz=-5e6,
        clock=(1.01, 1.0),
        background=(1.0, 2.0),
        crosstalk=0.1,
        trials=(1e4, 1e4),
        recovery=1.0,
        compression=1.0,
        curvature_x=3.0,
        baseline_m=(0.003, 0.0, 0.0),
        aperture_m=1e-3,
    )
    assert all(effect_changes(on, effect) for effect in EFFECTS)
    with pytest.raises(InputError, match="effect 'gravity' is unknown"):
        on.without("gravity")


def test_the_aperture_blurs_a_zones_edge_and_keeps_its_light():
    plain, blurred = (zone_returns(view(0.05), replace(TWO, aperture_m=size)) for size in (0.0, 5e-3))
    assert len(blurred[0].light) > len(plain[0].light)
    assert blurred[0].light.sum() == pytest.approx(plain[0].light.sum(), rel=0.02)


@pytest.mark.parametrize(
    ("aperture_m", "baseline_m"), [(0.0, (0.0, 0.0, 0.0)), (5e-3, (0.0, 0.0, 0.0)), (5e-3, (0.004, -0.002, 0.001))]
)
def test_aperture_and_parallax_are_those_of_photons_followed_one_by_one(aperture_m, baseline_m):
    """Photons leave the emitter by its profile, meet a plane at 0.05 m, and enter the square aperture somewhere; the
    tangents that they then have say which zone sees them. Shares by chi-square at 0.1 %."""
    depth, count, rng = 0.05, 400_000, np.random.default_rng(5)
    zones = replace(TWO, curvature_x=8.0, curvature_y=3.0, aperture_m=aperture_m, baseline_m=baseline_m)
    edge = math.tan(math.radians(30))
    right, down = rng.uniform(-edge, edge, (2, count)) * depth
    away = depth - baseline_m[2]
    u, v = (right - baseline_m[0]) / away, (down - baseline_m[1]) / away
    kept = rng.random(count) < np.exp(-(8 * u**2 + 3 * v**2) / 2) / (1 + (right**2 + down**2) / depth**2) ** 2
    across, along = rng.uniform(-0.5, 0.5, (2, count)) * aperture_m
    x, y = (right - across) / depth, (down - along) / depth
    seen = [
        int((kept & (np.abs(x - zones.centre_x[n]) < 0.15) & (np.abs(y - zones.centre_y[n]) < 0.25)).sum())
        for n in range(2)
    ]
    found = zone_returns(view(depth, 200, baseline=baseline_m), zones)
    expected = np.array([count * one.light.sum() / (2 * edge) ** 2 for one in found])  # light by area in tangents
    assert ((seen - expected) ** 2 / expected).sum() < chi2.ppf(1 - 1e-3 / 3, 2)


def test_a_clock_that_slows_down_does_not_run_back_and_a_wild_one_is_refused():
    time = np.linspace(0, 4, 50)
    slowed = chirped(time, -0.25)
    assert (np.diff(slowed) >= 0).all() and slowed[-1] == pytest.approx(1.0)
    assert chirped(time, 0.1) == pytest.approx(time + 0.1 * time**2)
    limit = 0.25 / (SENSOR.bins * SENSOR.bin_width_s)
    for chirp in (0.99 * limit, -0.99 * limit):
        SensorFile(SENSOR, zones=replace(TWO, chirp_hz=chirp))
    for chirp in (1e300, -1.01 * limit):
        with pytest.raises(InputError, match=r"zones: chirp .* Hz, at most 3\.91e\+07 Hz"):
            SensorFile(SENSOR, zones=replace(TWO, chirp_hz=chirp))
        with pytest.raises(InputError, match="of 64 bins of 100 ps keep half of its rate"):
            expected_zone_counts(zone_returns(view(), TWO), SENSOR, replace(TWO, chirp_hz=chirp))


def test_the_emitters_profile_moves_with_parallax():
    """Light of exp(-k u^2 / 2), u the tangent seen from the emitter: at 10 mm a baseline of 2 mm shifts it by 0.2."""
    zones = replace(TWO, curvature_x=40.0)
    near = zone_returns(view(0.01, baseline=(0.002, 0, 0)), replace(zones, baseline_m=(0.002, 0.0, 0.0)))
    left, right = (returns.light.sum() for returns in near)
    assert right > 3 * left
    far = zone_returns(view(2.0, baseline=(0.002, 0, 0)), replace(zones, baseline_m=(0.002, 0.0, 0.0)))
    left, right = (returns.light.sum() for returns in far)
    assert right == pytest.approx(left, rel=0.02)
    with pytest.raises(InputError, match="emitter at 0 0 0 mm, the zones' is at 2 0 0 mm"):
        zone_returns(view(), replace(zones, baseline_m=(0.002, 0.0, 0.0)))


def test_delay_clock_and_crosstalk_by_their_definitions():
    one = [ZoneReturns(np.array([0.3]), np.array([0.3]), np.array([5.0])) for _ in range(2)]
    zones = replace(TWO, delay_s=(1e-9, 0.0), clock=(1.0, 1.25), gain=(2.0, 1.0), crosstalk=0.1)
    own = zone_signal(one, SENSOR, replace(zones, crosstalk=0.0))
    centre = own @ (np.arange(64) + 0.5) / own.sum(axis=1) * 1e-10
    arrival = 0.3 / 299792458
    assert centre == pytest.approx([arrival + 1e-9, arrival / 1.25], rel=1e-6)
    assert zone_signal(one, SENSOR, zones) == pytest.approx(own + 0.1 * own.sum(axis=0))
    late = zone_signal(one, SENSOR, zones, drift_s=2e-10)
    assert late[:, 2:] == pytest.approx(zone_signal(one, SENSOR, zones)[:, :-2], abs=1e-9)


@pytest.mark.parametrize("period_bins", [64, 100])
def test_light_later_than_the_period_wraps_at_it(period_bins):
    """A clock that is wrong by a hundredth, and one with a chirp, are so from the last emission on."""
    sensor = replace(SENSOR, period_s=period_bins * SENSOR.bin_width_s)
    zones = replace(TWO, clock=(1.01, 1.0), chirp_hz=1e6, delay_s=(2e-10, 0.0))
    period_m = 299792458 * sensor.period_s

    def signal(path_m: float) -> np.ndarray:
        path = np.array([path_m])
        return zone_signal([ZoneReturns(path, path + 0.1, np.array([5.0]))] * 2, sensor, zones)

    assert signal(0.4).sum(axis=1) == pytest.approx([5.0, 5.0])
    for turns in (1, 2):
        assert signal(0.4 + turns * period_m) == pytest.approx(signal(0.4), abs=1e-9)


@pytest.mark.parametrize("converter", [{"clock": (1.01,)}, {"chirp_hz": 1e6}, {"clock": (0.9,), "skew_s": (3e-10,)}])
def test_a_return_across_emissions_is_the_sum_of_its_pieces(converter):
    """A converter starts anew at each emission, also within an interval, which here holds two of them."""
    zone, period_m = ZoneArray((0.0,), (0.0,), (0.3,), (0.3,), **converter), 299792458 * SENSOR.period_s
    ends = np.array([0.9, 1.0, 2.0, 2.2]) * period_m
    whole = ZoneReturns(ends[:1], ends[-1:], np.array([1.3]))
    pieces = ZoneReturns(ends[:-1], ends[1:], np.diff(ends) / period_m)
    cut = zone_signal([pieces], SENSOR, zone)
    assert zone_signal([whole], SENSOR, zone) == pytest.approx(cut, abs=1e-9)
    assert cut.sum() == pytest.approx(1.3)


def test_pulses_across_the_ends_of_the_period_fold_and_the_unrecorded_part_is_lost():
    at_zero = [ZoneReturns(np.zeros(1), np.zeros(1), np.ones(1))] * 2
    whole = zone_signal(at_zero, SENSOR, TWO)
    assert whole.sum(axis=1) == pytest.approx([1.0, 1.0])
    assert whole[0] == pytest.approx(whole[0][::-1], abs=1e-11), "half of it comes before the emission"
    gated = replace(SENSOR, period_s=100 * SENSOR.bin_width_s)
    assert zone_signal(at_zero, gated, TWO).sum(axis=1) == pytest.approx([0.5, 0.5])
    late = replace(TWO, delay_s=(64.5e-10, 64e-10))
    assert zone_signal(at_zero, SENSOR, late)[0].argmax() == 0, "a delay may last into the next cycle"


@pytest.mark.parametrize(
    "pulse", [Pulse(1e-10), Pulse(2e-11, 4e-10), Pulse(3e-9), SampledPulse((1.0, 3.0, 0.5), 7e-11)]
)
@pytest.mark.parametrize("period_bins", [64, 150])
def test_light_is_binned_as_by_the_pulse_at_every_edge_of_every_cycle(pulse, period_bins):
    """Points, and intervals up to a period long, within the pulse's reach of the period's ends, too."""
    sensor = replace(SENSOR, pulse=pulse, period_s=period_bins * SENSOR.bin_width_s)
    zone, rng, period_m = ZoneArray((0.0,), (0.0,), (0.3,), (0.3,)), np.random.default_rng(4), C * sensor.period_s
    near = np.sort(np.concatenate(([0.0], rng.uniform(0, period_m, 40))))
    far = near + (period_m - near) * rng.choice([0.0, 1e-6, 1e-3, 0.1, 1.0], 41)
    light = rng.exponential(1.0, 41)
    found = zone_signal([ZoneReturns(near, far, light)], sensor, zone)
    edges, expected = torch.arange(65, dtype=torch.float64) * sensor.bin_width_s, np.zeros(64)
    start, length = (torch.from_numpy(path / C)[:, None] for path in (near, far - near))
    for cycle in range(-6, 7):
        arrived = interval_cdf(pulse, edges + cycle * sensor.period_s - start, length.expand(-1, 65))
        expected += np.diff(torch.from_numpy(light) @ arrived)
    assert found[0] == pytest.approx(expected, abs=1e-10 * light.sum())


DETECTORS = 50


def simulate(mu: np.ndarray, trials: int, recovery: float, rng: np.random.Generator) -> np.ndarray:
    """Event by event: 50 detectors of one converter, cycle after cycle, blind ones counted down."""
    counts, blind, cycles = np.zeros(len(mu), np.int64), np.zeros(DETECTORS, np.int64), recovery * DETECTORS
    for _ in range(trials):
        photons = rng.poisson(mu.sum())
        where = np.sort(rng.choice(len(mu), photons, p=mu / mu.sum()))
        by = rng.integers(0, DETECTORS, photons)
        blind_now, timed = blind > 0, False
        blind[blind_now] -= 1
        for at, one in zip(where, by, strict=True):
            if blind_now[one]:
                continue
            blind_now[one] = True
            blind[one] = math.floor(cycles) + (rng.random() < cycles % 1)
            counts[at] += not timed
            timed = True
    return counts


@pytest.mark.parametrize("recovery", [0.0, 0.12, 0.6])
def test_saturation_is_the_event_by_event_simulation(recovery):
    """Chi-square over bins at 0.1 %; that each of 50 detectors fires once a cycle is worth 1 % of the light."""
    rng, trials = np.random.default_rng(5), 20_000
    mu = np.concatenate([np.full(6, 0.01), [0.2, 0.5, 0.3, 0.1], np.full(6, 0.02)])
    flux, many = mu[None] * trials, np.array([float(trials)])
    expected = saturated(flux, many, recovery)[0]
    counts = simulate(mu, trials, recovery, rng)
    off = np.maximum(np.abs(counts - expected) - 0.012 * expected, 0)
    assert float((off**2 / expected).sum()) < chi2.ppf(0.999, len(mu))
    if recovery:  # the test can tell it from none
        assert float(((counts - saturated(flux, many, 0.0)[0]) ** 2 / expected).sum()) > 3 * chi2.ppf(0.999, len(mu))
    drawn = np.array([draw_saturated(flux, many, recovery, rng)[0] for _ in range(400)])
    assert np.abs(drawn.mean(axis=0) - expected).max() < 5 * np.sqrt(expected.max() / 400)
    total = drawn.sum(axis=1)
    share = expected.sum() / trials
    assert total.std() == pytest.approx(math.sqrt(trials * share * (1 - share)), rel=5 / math.sqrt(800))


@pytest.mark.parametrize("trials", [0.3, 1.4, 1.5, 3.6, 20.4])
def test_draws_of_trials_that_are_no_whole_number_have_the_mean_of_the_law(trials):
    """A fit gives such numbers. Rounding them made counts of 0.3 trials 3.3 times as many, of 1.4 trials 29 % fewer."""
    draws = 20_000
    flux, many = np.tile([0.2, 0.05, 0.5, 0.1], (draws, 1)), np.full(draws, trials)  # as many zones, all alike
    drawn = draw_saturated(flux, many, 0.3, np.random.default_rng(8), 0.2)
    expected = saturated(flux, many, 0.3, 0.2)[0]
    assert np.abs(drawn.mean(axis=0) - expected).max() < 5 * np.sqrt(expected.max() / draws)
    assert drawn.sum(axis=1).max() <= math.ceil(trials), "a trial gives one count at most"


def test_without_trials_to_lose_nothing_saturates_and_compression_is_as_stated():
    flux = np.array([[3.0, 100.0, 7.0]])
    assert saturated(flux, np.array([math.inf]), 3.0, 2.0) == pytest.approx(flux)
    first = saturated(flux, np.array([1e3]), 0.5)
    assert saturated(flux, np.array([1e3]), 0.5, 2.0) == pytest.approx(first / (1 + 2 * first / 1e3))


def test_the_derivative_of_saturation_is_its_finite_difference():
    rng = np.random.default_rng(3)
    flux, slope = rng.uniform(1, 300, (2, 9)), rng.normal(size=(2, 9, 3))
    trials = np.array([900.0, math.inf])
    found = saturated_jacobian(flux, slope, trials, 0.7, 1.3)
    for column in range(3):
        up, down = (saturated(flux + sign * 1e-4 * slope[..., column], trials, 0.7, 1.3) for sign in (1, -1))
        assert found[..., column] == pytest.approx((up - down) / 2e-4, rel=1e-5, abs=1e-7)


def test_zones_are_laid_out_as_they_look_and_take_a_budget():
    nine = ZoneArray(*zip(*[(x, y, 0.1, 0.1) for x in (0.2, 0.0, -0.2) for y in (0.2, 0.0, -0.2)], strict=True))
    rows, columns, order = zone_grid(nine)
    assert (rows, columns) == (3, 3) and order.tolist() == [8, 5, 2, 7, 4, 1, 6, 3, 0]
    transient = view()
    budgeted = with_budget(nine, transient, SENSOR, PhotonBudget(2000.0, 640.0))
    histogram = sense_zones(transient, SENSOR, budgeted, seed=1)
    assert histogram.counts.shape == (3, 3, 64) and histogram.expected_signal.mean() == pytest.approx(2000, rel=1e-5)
    assert histogram.counts.sum() == pytest.approx(9 * 2640, abs=5 * math.sqrt(9 * 2640))
    again = sense_zones(transient, SENSOR, budgeted, seed=1)
    assert (again.counts == histogram.counts).all()
    with pytest.raises(InputError, match="look beside the image"):
        sense_zones(view(fov_deg=20.0), SENSOR, nine)
    nothing = seen_by_a_camera(np.full((9, 9), np.nan))
    with pytest.raises(InputError, match=f"within the 6.4 ns that {SENSOR.name} records: 9 photons cannot be had"):
        with_budget(nine, nothing, SENSOR, PhotonBudget(9.0, 1.0))


def seen_by_a_camera(depth_m: np.ndarray) -> Transient:
    """White pixels at given depths, NaN for none, in a field of view of 60 degrees."""
    ones = np.ones(depth_m.shape)
    return transient_from_rgbd(depth_m, ones, np.zeros_like(ones), meta={"camera": {"fov_deg": 60.0}})


@pytest.mark.parametrize("rows", [1, 9])
def test_one_column_of_pixels_lights_a_zone(rows):
    """A column is as wide as the field of view, 1.15: the zone lies within its middle pixel, which looks straight
    ahead at a white wall 1 m away. That returns 1 / pi."""
    zone = ZoneArray((0.0,), (0.0,), (0.3,), (0.3,))
    returns = zone_returns(seen_by_a_camera(np.full((rows, 1), 1.0)), zone)[0]
    assert returns.light.sum() == pytest.approx(0.3 * 0.3 / math.pi, rel=1e-6)


def test_the_modules_own_reflection_is_there_where_a_zone_sees_nothing():
    zone = ZoneArray((0.0,), (0.0,), (0.3,), (0.3,), gain=(1e3,), leak=(2.0,), echo_m2=(0.1,))
    depth = np.full((9, 9), np.nan)
    nothing = zone_signal(zone_returns(seen_by_a_camera(depth), zone), SENSOR, zone)
    depth[4, 4] = 1.8
    faint = replace(seen_by_a_camera(depth), radiance=np.array([1e-9], np.float32))
    some = zone_signal(zone_returns(faint, zone), SENSOR, zone)
    assert nothing == pytest.approx(some, abs=1e-3) and nothing.sum() > 900
    dark = replace(zone, leak=(0.0,))
    assert not zone_signal(zone_returns(seen_by_a_camera(np.full((9, 9), np.nan)), dark), SENSOR, dark).any()


def test_what_zones_lose_and_where_they_look():
    """Shot noise is no loss; pile-up is of each zone's own trials; a zone beside the image is told."""
    zones = replace(TWO, gain=(1e4, 1e4))
    histogram = sense_zones(view(), SENSOR, zones, seed=3)
    assert histogram.meta["plan"] == ["zones: 2 fields of view"] and histogram.meta["pile_up"] == 0
    bright = sense_zones(view(), SENSOR, replace(zones, gain=(1e6, 1e4), trials=(math.inf, 1e3)), seed=3)
    signal = float(bright.expected_signal.min())
    assert bright.meta["pile_up"] == pytest.approx(signal / 1e3, rel=1e-5)
    assert "lost to saturation" in bright.meta["plan"][0]
    half_view = math.tan(math.radians(30))
    aside = replace(TWO, centre_x=(-half_view, 0.2))
    assert "1 of 2 look partly beside the image, by up to 50 %" in sense_zones(view(), SENSOR, aside).meta["plan"][1]


def test_every_zone_is_reported_as_progress():
    told: list[tuple[str, float]] = []
    sense_zones(view(), SENSOR, TWO, progress=lambda what, fraction: told.append((what, fraction)))
    assert told == [("zones", 0.0), ("zones", 0.5)]
    with_budget(TWO, view(), SENSOR, PhotonBudget(1.0, 1.0), progress=lambda what, fraction: told.append((what, 1.0)))
    assert len(told) == 4


def test_zones_tell_how_much_of_their_light_wraps():
    """A plane at 0.3 m in a period of 0.96 m, and one at 1.2 m."""
    sensor = replace(SENSOR, period_s=6.4e-9)
    assert sense_zones(view(), sensor, TWO).meta["wrapped"] == 0
    late = sense_zones(view(1.2), sensor, TWO).meta
    assert late["wrapped"] == pytest.approx(1)
    assert any(line.startswith("wrap: 100.000% of the light") for line in late["plan"])
    assert late["dark_share"] is None, "a zone's background is not told apart"
    period_m = 1.9187  # of path: returns on both sides of the period's end count by what lies behind it
    near, far = (np.array(ends) * period_m for ends in ([0.9, 1.0, 1.2], [1.4, 1.0, 1.5]))
    ends = ZoneReturns(near, far, np.ones(3))
    assert ends.fraction_behind(period_m) == pytest.approx([0.8, 1, 1])
