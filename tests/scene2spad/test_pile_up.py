"""Pile-up of measured pulses: the law in two routes, and what the shipped pulses say of it."""

import numpy as np
import pytest

from scene2spad.studies.sim_to_real.pile_up import (
    HIGH,
    LOW,
    best_of,
    compressed,
    draw_pile_up,
    measured_pulses,
    misfit,
    pile_up_rows,
    piled_up,
)


def test_a_free_running_detector_whose_dead_time_ends_between_pulses_has_the_first_photons_shape():
    """Dead for 1.4 periods after each detection, photon after photon: within five sigma in every bin."""
    pulse = np.array([0.1, 0.5, 0.3, 0.05, 0.05, *[0.0] * 15])
    rng, flux, cycles, ready = np.random.default_rng(4), 0.9, 30_000, 0.0
    counts = np.zeros(len(pulse))
    for cycle, photons in enumerate(rng.poisson(flux * pulse, (cycles, len(pulse)))):
        for at in np.flatnonzero(photons):
            if cycle * 20 + at >= ready:
                counts[at] += 1
                ready = cycle * 20 + at + 28
    expected = piled_up(pulse, flux) * counts.sum()
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected.max())
    assert np.abs(counts - pulse * counts.sum()).max() > 7 * np.sqrt(expected.max())  # unlike the pulse


def test_the_shape_is_compared_up_to_scale_and_shift():
    pulse = measured_pulses()[LOW[0]]
    assert misfit(3 * np.roll(pulse, 2), pulse) < 0.01
    assert misfit(pulse, piled_up(pulse, 1.0)) > 0.1 and compressed(pulse, 0.0) == pytest.approx(pulse)


def test_first_photons_do_not_explain_the_shipped_pulse_at_high_flux(tmp_path):
    """Compare second lobes: a law that loses later photons makes it weaker than at low flux, measured it is not."""
    rows = pile_up_rows()
    law = [row for row in best_of(rows) if row["law"] == "first photon"]
    assert [row["number"] for row in law] == [0.0, 0.0]
    pulses = measured_pulses()
    assert pulses[HIGH].sum() == pytest.approx(1) and law[0]["second_lobe_measured"] > law[0]["second_lobe"]
    assert draw_pile_up(tmp_path / "pile-up.png").is_file()
