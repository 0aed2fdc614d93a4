"""Cores with arrival times against the queue's closed form, an independent queue, and the untimed core."""

import math

import numpy as np
import pytest

from scenes.errors import InputError
from ultraphase import ChipSpec, Core, assemble, method
from ultraphase.arrivals import TimedCore, lost_fraction, poisson_arrivals
from ultraphase.tables import int8_codes

CLOCKS = {"fourier-8": 135, "coarse-64": 24, "fourier-16": 255}


def timed(name: str, port: int = 1) -> TimedCore:
    chosen = method(name)
    angle = 2 * np.pi * np.arange(1, chosen.codes // 2 + 1)[:, None] * (np.arange(1024) + 0.5) / 1024
    waves = int8_codes(np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(-1, 1024))
    return TimedCore(chosen.program(), chosen.tables(waves) if chosen.temporal_bins else {}, port=port)


def plain_queue(clocks: np.ndarray, service: float, idle: float, read: float) -> int:
    """Photons read, look by look: a queue without a program."""
    now, held, taken, at = 0.0, False, 0, 0
    while at < len(clocks) or held:
        while at < len(clocks) and clocks[at] <= now:  # up to the look
            held, at = True, at + 1
        if not held:
            now += idle * max(1, (clocks[at] - now) // idle)
            continue
        while at < len(clocks) and clocks[at] <= now + read:  # lost: the port is read later
            at += 1
        taken, held = taken + 1, False
        now += service
    return taken


@pytest.mark.parametrize("name", CLOCKS)
@pytest.mark.parametrize("rho", [0.2, 1.0, 3.0])
def test_lost_photons_are_the_closed_forms(name, rho):
    frame = int(12_000 * CLOCKS[name] / min(rho, 1.0))
    clocks = poisson_arrivals(rho / CLOCKS[name], frame, seed=3)
    stamps = np.random.default_rng(4).integers(0, 1024, len(clocks))
    core = timed(name)
    found = core.timed_frame(clocks, stamps, frame)
    expected = lost_fraction(rho / CLOCKS[name], CLOCKS[name])
    # losses come in bursts: their number varies by no more than twice what independent ones would
    spread = 2 * np.sqrt(expected * (1 - expected) / len(clocks))
    assert abs(found.lost_fraction - expected) < 4 * spread + 2e-4
    assert found.read + found.lost == found.arrived == len(clocks)
    assert abs(found.read - plain_queue(clocks, CLOCKS[name], 9, 3)) <= 1  # the last one may come behind the end


def test_the_closed_form_becomes_the_queue_with_one_place():
    for rho in (0.05, 0.5, 1.0, 4.0):
        with_one_place = 1 - 1 / (rho + np.exp(-rho))  # M/D/1: a core that looks at its port all the time
        near = lost_fraction(rho, 1.0, idle_clocks=1e-7, read_clocks=0.0)
        assert near == pytest.approx(with_one_place, rel=1e-5)
        assert lost_fraction(rho / 135, 135) > with_one_place  # looking now and then loses more
    assert lost_fraction(0.0, 135) == 0 and lost_fraction(1e3, 135) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    "photon", [["ADD r2, r2, #1"], ["MOV r2, #1"], ["MOV r2, #1"] * 5], ids=["counted", "as it was", "longer"]
)
@pytest.mark.parametrize("whole", [True, False], ids=["whole clocks", "any time"])
def test_turns_of_an_idle_loop_that_are_counted_are_as_if_they_were_run(photon, whole):
    """Photons at the very clock of a look, and those that leave the core as it was, are seen when they are there."""
    lines = ["wait: BNT none", "RDT r1", *photon, "JMP wait", "none: BFE end", "JMP wait", "end: HALT"]
    core, random = TimedCore(assemble("\n".join(lines))), np.random.default_rng(6)
    service = 3 * (3 + len(photon))
    for _ in range(60):
        clocks = np.sort(random.integers(0, 900, 30) if whole else 900 * random.random(30)).astype(float)
        found = core.timed_frame(clocks, random.integers(0, 2, 30), 1500)
        assert found.read == plain_queue(clocks, service, 9, 3)


def test_photons_of_a_pulsed_laser_come_together_and_are_lost_more_often():
    """The page's 11.5 % at rho = 0.5 with half of all photons in one time bin of the laser's period, 11.0 % without."""
    photons, service, period = 400_000, CLOCKS["fourier-8"], 100e-9 / ChipSpec().clock_s
    random = np.random.default_rng(5)
    cycles = random.integers(0, int(photons * service / 0.5 // period), photons)
    even = random.random(photons)
    one_bin = np.where(random.random(photons) < 0.5, (300 + random.random(photons)) / 1024, even)
    for place, share in ((even, 0.110), (one_bin, 0.115)):
        lost = 1 - plain_queue(np.sort((cycles + place) * period), service, 9, 3) / photons
        assert lost == pytest.approx(share, abs=0.002)


def test_codes_are_those_of_the_photons_that_were_read():
    """Slow photons: nothing is lost, and what leaves is what a core without a clock puts out."""
    clocks = np.arange(200) * 1000.0
    stamps = np.random.default_rng(1).integers(0, 1024, 200)
    core = timed("fourier-8")
    found = core.timed_frame(clocks, stamps, 200_000)
    tables = {"quarter": core.contents("quarter")}
    assert found.lost == 0 and found.out == Core(core.program, tables).frame(stamps)[0]
    again = core.timed_frame(clocks[:1], stamps[:1], 2000)  # frames follow each other
    assert again.read == 1 and again.out == Core(core.program, tables).frame(stamps[:1])[0]
    assert again.clocks >= 2000


def test_a_second_photon_waits_and_a_third_is_lost():
    core = timed("fourier-8")
    for port, lost in ((1, 1), (2, 0)):
        core.port = port
        found = core.timed_frame(np.array([0.0, 30.0, 60.0]), np.array([5, 6, 7]), 2000)
        assert (found.read, found.lost) == (3 - lost, lost)
    assert core.timed_frame(np.zeros(0), np.zeros(0, int), 500).arrived == 0


@pytest.mark.parametrize(("rate", "named"), [(-1, "-1"), (math.nan, "nan"), (math.inf, "inf")])
def test_rates_that_no_process_has_are_refused(rate, named):
    with pytest.raises(InputError, match=f"a rate of {named} photons a clock, expected a finite number of 0 or more"):
        poisson_arrivals(rate, 1000, seed=0)
    with pytest.raises(InputError, match="a frame of -5 clocks, expected 0 or more"):
        poisson_arrivals(0.1, -5, seed=0)
    assert len(poisson_arrivals(0, 1000, seed=0)) == 0


def test_arrivals_that_are_none_are_refused():
    core = timed("coarse-64")
    for clocks in ([2.0, 1.0], [-1.0, 2.0], [1.0, 5000.0], [1.0]):
        with pytest.raises(InputError, match="rising clocks from 0 to below 5000"):
            core.timed_frame(np.array(clocks), np.array([1, 2]), 5000)
    with pytest.raises(InputError, match="port of 0"):
        timed("coarse-64", port=0)
