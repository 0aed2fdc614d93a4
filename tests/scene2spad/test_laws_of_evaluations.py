"""Laws that evaluations draw photons by, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene2spad.datasets.planes import wall
from scene2spad.networks.training import baseline
from spad.detection.detect import sense
from spad.estimators.depth import estimate_depth
from spad.sensor.model import PhotonBudget, Sensor

BRIGHT = PhotonBudget(600, 600)
FEW_CYCLES = replace(Sensor(), exposure_s=1000 * Sensor().period_s)  # 1.2 detections a cycle


@pytest.mark.parametrize("law", ["poisson", "first-photon"])
def test_coates_undoes_the_law_that_drew_the_photons_and_no_other(law):
    """Poisson counts are more than cycles here: undone as first photons, they were refused."""
    histogram = sense(wall(9.0, 4), FEW_CYCLES, BRIGHT, model=law)
    found, matched = (baseline(name)(histogram) for name in ("coates", "log-matched"))
    if law == "poisson":
        np.testing.assert_allclose(found, matched, atol=1e-3)
    else:
        undone = estimate_depth(torch.from_numpy(histogram.counts), FEW_CYCLES, "coates", law=law)
        np.testing.assert_array_equal(found, undone)
        errors = [np.abs(depth - histogram.depth_m).mean() for depth in (found, matched)]
        assert errors[0] < 0.5 * errors[1]
