"""Dead pixels detect nothing, crosstalk included, and training patches have the dead pixels and the crosstalk of
`sense`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_training_patches import SENSOR, scenes

from scenes.errors import InputError
from spad.detection.detect import sense, sense_timestamps
from spad.detection.device_patches import DevicePatches
from spad.detection.flux import expected_counts
from spad.detection.laws import add_crosstalk
from spad.detection.rates import rates_for
from spad.detection.training_patches import Patch, pack_views, sense_patches
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.tdc import Tdc

HEIGHT, WIDTH, DRAWS = 12, 10, 400
ODD = replace(SENSOR, dead_share=0.3, crosstalk=0.05)
TIMED = replace(ODD, tdc=Tdc(SENSOR.period_s / 8, codes=8))


@pytest.mark.parametrize("model", ["poisson", "first-photon", "free-running"])
def test_dead_pixels_detect_no_crosstalk(model: str) -> None:
    sensor = Sensor(dead_share=0.3, crosstalk=0.05, dead_time_s=10e-9)
    scene, budget = scenes(1)[0], PhotonBudget(100, 100)
    histogram = sense(scene, sensor, budget, model=model)
    dead = sensor.dead_pixels(HEIGHT, WIDTH)
    assert dead.sum() == 36 and not histogram.counts[dead].any()
    stamps = sense_timestamps(scene, sensor, budget, model=model)
    assert (stamps.counts() == histogram.counts).all()
    # crosstalk between pixels that are alive stays: a twentieth of what their live neighbours detect
    primaries = histogram.expected_signal + histogram.expected_background
    assert histogram.counts.sum() > primaries.sum() + 4 * np.sqrt(primaries.sum())


def test_crosstalk_beyond_the_limit_of_a_bin_is_refused() -> None:
    counts = np.full((2, 2, 1), 2**31 - 1000, np.int32)
    with pytest.raises(InputError, match=r"^a bin holds 2\d+ counts, the limit is 2147483647$"):
        add_crosstalk(counts, 0.05, np.random.default_rng(0))


def expected_with_crosstalk(sensor: Sensor, budget: PhotonBudget) -> np.ndarray:
    """Detections (H, W, T) of a view: a pixel's own, and a part of each neighbour's. In bins without converters."""
    scene = scenes()[1]
    rates = rates_for(scene, sensor, budget)
    own = expected_counts(scene, sensor, rates, slice(0, HEIGHT * WIDTH))[0].numpy().reshape(HEIGHT, WIDTH, -1)
    around = np.pad(own, ((1, 1), (1, 1), (0, 0)))
    fired = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return (own + sensor.crosstalk * fired) * rates.alive[..., None]


@pytest.mark.parametrize("on", ["host", "device"])
@pytest.mark.parametrize("corner", [(3, 4), (0, 0), (8, 5)], ids=["inside", "first corner", "last corner"])
@pytest.mark.parametrize("sensor", [ODD, replace(ODD, crosstalk=0.0), TIMED], ids=["both", "dead alone", "converters"])
def test_patches_have_dead_pixels_and_crosstalk(on: str, corner: tuple[int, int], sensor: Sensor) -> None:
    """Counts of a pixel and bin are Poisson: its own detections, and thinned ones of its neighbours in the view, which
    may be outside of the patch."""
    row, column = corner
    packed, patches = pack_views(scenes()), [Patch(1, row, column, 20.0, 10.0, seed=(9, i)) for i in range(DRAWS)]
    if on == "host":
        counts = sense_patches(packed, sensor, patches, size=(4, 5)).counts
    else:
        counts = DevicePatches(packed, sensor, "cpu").sense(patches, size=(4, 5), seed=4).counts
    total = np.moveaxis(counts.sum(dim=(0, 1)).double().numpy(), 0, -1)
    part = (slice(row, row + 4), slice(column, column + 5))
    dead = sensor.dead_pixels(HEIGHT, WIDTH)[part]
    assert dead.any() and not total[dead].any()
    expected = DRAWS * expected_with_crosstalk(sensor, PhotonBudget(20, 10))[part]
    if sensor.tdc is not None:  # converters name the bins: they are as many
        total, expected = total.sum(axis=-1), expected.sum(axis=-1)
    tail = np.minimum(stats.poisson.cdf(total, expected), stats.poisson.sf(total - 1, expected))
    assert 2 * tail.min() > 1 - (1 - 1e-3) ** (1 / total.size)
    assert abs(total.sum() - expected.sum()) < 4 * np.sqrt(expected.sum() * (1 + 4 * sensor.crosstalk))
