"""The normal distribution agrees with scipy's to the last digits, tails included."""

import numpy as np
import scipy.special

from spad.sensor.normal import erfc, erfcx_far, ndtr


def test_as_scipy():
    x = np.concatenate((np.linspace(-12, 12, 4001), [0.0, 1e-300, -1e-300, 37.0, -37.0, np.inf, -np.inf]))
    np.testing.assert_allclose(erfc(x), scipy.special.erfc(x), rtol=1e-13, atol=0)
    np.testing.assert_allclose(ndtr(x), scipy.special.ndtr(x), rtol=1e-12, atol=0)
    assert erfc(x).dtype == np.float64 and ndtr(0.0) == 0.5 and np.isnan(ndtr(np.nan))
    assert ndtr(x.reshape(1, -1)).shape == (1, len(x)) and erfc(np.empty(0)).shape == (0,)


def test_scaled_erfc_as_scipy():
    x = np.concatenate((np.geomspace(20, 1e150, 2001), [np.inf]))
    np.testing.assert_allclose(erfcx_far(x), scipy.special.erfcx(x), rtol=1e-14, atol=0)
