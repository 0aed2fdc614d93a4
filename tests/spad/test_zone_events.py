"""Every effect of a multi-zone sensor against a simulation that follows one photon after the other."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.zone_array import ZoneArray
from spad.zones.simulation import ZoneReturns, expected_zone_counts

SENSOR = Sensor(name="s", bins=48, bin_width_s=1e-10, pulse=Pulse(1.2e-10))
ZONES = {"centre_x": (-0.2, 0.2), "centre_y": (0.0, 0.0), "width": (0.1, 0.1), "height": (0.1, 0.1)}
LIGHT = [
    ZoneReturns(np.array([0.25, 0.5]), np.array([0.3, 0.5]), np.array([3.0, 1.0])),
    ZoneReturns(np.array([0.4]), np.array([0.55]), np.array([2.0])),
]
SPEED = 299_792_458.0
EFFECTS = {
    "none": {},
    "gain": {"gain": (200.0, 700.0)},
    "delay": {"delay_s": (4e-10, -2e-10)},
    "skew": {"skew_s": (5e-10, 2e-10)},
    "clock": {"clock": (1.1, 0.95)},
    "chirp": {"chirp_hz": 4e7},
    "background": {"background": (30.0, 5.0)},
    "leak": {"leak": (0.5, 0.0)},
    "echo": {"echo_m2": (4e-3, 8e-3)},
    "crosstalk": {"crosstalk": 0.3},
    "saturation": {"trials": (9000.0, 20_000.0)},
    "recovery": {"trials": (9000.0, 20_000.0), "recovery": (0.6, 1.0)},
    "all": {
        "gain": (300.0, 500.0), "delay_s": (4e-10, -2e-10), "skew_s": (5e-10, 2e-10), "clock": (1.1, 0.95),
        "background": (30.0, 5.0), "leak": (0.5, 0.1), "echo_m2": (4e-3, 8e-3), "crosstalk": 0.3,
        "trials": (9000.0, 20_000.0), "recovery": (0.6, 1.0), "chirp_hz": -3e7,
    },
}  # fmt: skip


def photon_times(zone: int, zones: ZoneArray, rng: np.random.Generator) -> np.ndarray:
    """Times [s] that one zone's converter gives the photons of one exposure, by the definitions of its switches."""
    near, far, light = LIGHT[zone]
    paths = [rng.uniform(n, f, rng.poisson(w * zones.gain[zone])) for n, f, w in zip(near, far, light, strict=True)]
    paths.append(np.zeros(rng.poisson(zones.leak[zone] * zones.gain[zone])))
    echoed = zones.echo_m2[zone] * sum(w / ((n + f) / 4) ** 2 for n, f, w in zip(near, far, light, strict=True))
    paths.append(rng.uniform(2 * near.min(), 2 * far.max(), rng.poisson(echoed * zones.gain[zone])))
    path = np.concatenate(paths)
    path %= SPEED * SENSOR.period_s  # light later than a period is of the cycle after
    side = rng.choice([-0.5, 0.5], len(path))  # which half of the zone's detectors
    skew = side * zones.skew_s[zone] * zones.clock[zone] * SPEED  # as a path, before the clock
    u = (path + skew) / SPEED / zones.clock[zone]
    time = u + zones.chirp_hz * u**2 + zones.delay_s[zone]
    return time + SENSOR.pulse.draw(rng, len(path))


DETECTORS = 64  # of a zone's converter


def detected(bins: np.ndarray, trials: float, recovery: float, rng: np.random.Generator) -> np.ndarray:
    """Bins of the photons that are timed: each falls into a trial and on a detector, which is blind for
    recovery x DETECTORS further trials after it; the converter takes a trial's first."""
    if math.isinf(trials):
        return bins
    trial, detector = rng.integers(0, int(trials), len(bins)), rng.integers(0, DETECTORS, len(bins))
    blind_until, last, timed = np.full(DETECTORS, -1), -1, []
    for at in np.lexsort((bins, trial)):
        now, one = trial[at], detector[at]
        if now <= blind_until[one]:
            continue
        cycles = recovery * DETECTORS
        blind_until[one] = now + math.floor(cycles) + (rng.random() < cycles % 1)
        if now != last:
            timed.append(bins[at])
        last = now
    return np.array(timed, dtype=np.int64)


def simulate(zones: ZoneArray, rng: np.random.Generator) -> np.ndarray:
    """Counts (Z, T) of one exposure."""
    counts = np.zeros((2, SENSOR.bins), np.int64)
    for zone in range(2):
        times = [photon_times(zone, zones, rng)]
        for other in range(2):  # scattered light has its own zone's times
            scattered = photon_times(other, zones, rng)
            times.append(scattered[rng.random(len(scattered)) < zones.crosstalk])
        # delays and the pulse, too, carry light beyond the ends of the period, which the bins cover
        bins = np.floor(np.concatenate(times) % SENSOR.period_s / SENSOR.bin_width_s).astype(np.int64)
        dark = np.repeat(np.arange(SENSOR.bins), rng.poisson(zones.background[zone], SENSOR.bins))
        seen = np.concatenate((bins, dark))
        counted = detected(seen, zones.trials[zone], zones.recovery[zone], rng)
        counts[zone] = np.bincount(counted, minlength=SENSOR.bins)
    return counts


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_its_event_by_event_simulation(effect):
    """Chi-square over all bins that expect 5 or more, at 0.1 % over all cases; saturated counts spread less."""
    zones = ZoneArray(**ZONES, **{"gain": (300.0, 500.0), **EFFECTS[effect]})
    rng, repeats = np.random.default_rng(11), 12
    counts = sum(simulate(zones, rng) for _ in range(repeats))
    expected = repeats * expected_zone_counts(LIGHT, SENSOR, zones)
    enough = expected >= 5
    statistic = float(((counts - expected) ** 2 / np.maximum(expected, 1e-9))[enough].sum())
    assert statistic < chi2.ppf(1 - 0.001 / len(EFFECTS), int(enough.sum()))
    assert counts[~enough].sum() == pytest.approx(
        expected[~enough].sum(), abs=5 * math.sqrt(expected[~enough].sum() + 1)
    )
    if effect != "none":  # the test can tell the effect from none
        plain = repeats * expected_zone_counts(LIGHT, SENSOR, ZoneArray(**ZONES, gain=(300.0, 500.0)))
        unlike = float(((counts - plain) ** 2 / np.maximum(plain, 1.0)).sum())
        assert unlike > 3 * statistic
