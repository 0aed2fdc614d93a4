"""Supplementary Figure 5: printed columns from printed clocks, both readings of the power, and the emulation beside."""

import numpy as np
import pytest

from scenes.errors import InputError
from ultraphase import ChipSpec, Core, CoreArray, assemble, method, verify
from ultraphase.catalog import PUBLISHED
from ultraphase.power import NEEDS_TIME, Cost, Load, as_csv, cost_of, measured_cost, power, reference_bits, sweep, table
from ultraphase.tables import int8_codes


def test_speed_is_the_published_140_million_operations():
    assert ChipSpec().instructions_per_second == pytest.approx(140e6, rel=1e-3)


def printed(name: str) -> Cost:
    row = PUBLISHED[name]
    return Cost(row.clocks, 0, 8 * row.bytes_per_pixel)


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_printed_column_follows_from_the_printed_clocks(name):
    row, found = PUBLISHED[name], power(printed(name), Load())
    assert found.frame_time_s == pytest.approx(row.frame_time_s, rel=6e-3)
    assert found.data_rate_bit_per_s / 8000 == pytest.approx(row.rate_kb_per_s, rel=6e-3)
    assert 1e6 * found.processing_published_w == pytest.approx(row.processing_uw, rel=6e-3)
    assert 1e6 * found.readout_w == pytest.approx(row.readout_uw, rel=6e-3)


@pytest.mark.parametrize("name", PUBLISHED)
def test_unrounded_clocks_give_the_print_to_its_last_digit(name):
    row = PUBLISHED[name]
    found = power(Cost(row.unrounded_clocks, 0, 0), Load())
    assert abs(row.unrounded_clocks - row.clocks) <= 0.5
    assert f"{found.frame_time_s:.2e}" == f"{row.frame_time_s:.2e}"
    assert f"{1e6 * found.processing_published_w:.2e}" == f"{row.processing_uw:.2e}"


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_two_readings_differ_by_the_frame_time(name):
    found = power(printed(name), Load(photons=123, frames_per_s=17, pixels=9))
    assert found.processing_energy_w * found.frame_time_s == pytest.approx(found.processing_published_w, rel=1e-12)


def test_the_two_readings_lead_to_opposite_conclusions():
    rows = {name: power(printed(name), Load()) for name in PUBLISHED}
    assert all(row.readout_w > 10 * row.processing_published_w for row in rows.values())
    more = [name for name, row in rows.items() if row.processing_energy_w > row.readout_w]
    assert more == [name for name in PUBLISHED if name != "coarse-256"]
    assert 1e6 * rows["fourier-16"].processing_energy_w == pytest.approx(76.7, rel=1e-3)


def test_references_and_megapixels():
    bits = reference_bits(550)
    assert bits == {"raw timestamps": 5500, "full histogram": 8192}
    megapixel = Load(pixels=1 << 20)
    watts = {name: power(Cost(0, 0, size), megapixel).readout_w for name, size in bits.items()}
    assert watts == pytest.approx({"raw timestamps": 9.42, "full histogram": 14.03}, rel=1e-3)
    assert power(printed("fourier-16"), megapixel).processing_energy_w == pytest.approx(20.1, rel=2e-3)


def costs() -> dict[str, Cost]:
    return {name: measured_cost(method(name), tensor(name)) for name in PUBLISHED}


def tensor(name: str):
    chosen = method(name)
    if not chosen.temporal_bins:
        return None
    centres = (np.arange(chosen.temporal_bins) + 0.5) / chosen.temporal_bins
    angle = 2 * np.pi * np.arange(1, chosen.codes // 2 + 1)[:, None] * centres
    return int8_codes(np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(chosen.codes, -1))


def test_table_shows_residuals_of_the_emulation():
    rows = {row["name"]: row for row in table(costs())}
    residuals = {name: row["residual_clocks"] for name, row in rows.items()}
    assert residuals == {
        "coarse-16": -3, "coarse-64": 0, "coarse-256": 0, "fourier-8": -75, "fourier-16": -75,
        "separable-8": -94, "separable-16": -94,
    }  # fmt: skip
    for name, row in rows.items():
        assert row["emulated"]["bytes_per_pixel"] == PUBLISHED[name].bytes_per_pixel  # measured: what left the cores
        assert row["emulated"]["frame_end_clocks"] > 0
        assert (row["emulated"]["frame_end_waits"] > 0) == name.startswith("separable")
    # of a block of 2 x 2: 64 numbers, each loaded, weighted, cleared and passed on or added up
    assert rows["separable-16"]["emulated"]["frame_end_clocks"] > 64 * 3 * 8
    assert "residual_clocks" in as_csv(list(rows.values())).splitlines()[0]
    assert len(as_csv(list(rows.values())).splitlines()) == 8


def test_sweep_has_every_combination_and_says_what_is_too_fast():
    rows = sweep({"fourier-16": Cost(255, 258, 256)}, (550, 1e6), (30, 1000), (4, 1 << 20))
    assert len(rows) == 3 * 2 * 2 * 2
    one = next(r for r in rows if r["name"] == "fourier-16" and r["photons"] == 1e6 and r["frames_per_s"] == 1000)
    assert not one["keeps_up"] and one["busy"] == pytest.approx((1e6 * 255 + 258) * 2.38e-9 * 1000)
    assert all(r["keeps_up"] for r in rows if r["photons"] == 550)
    assert next(r for r in rows if r["name"] == "raw timestamps")["bytes_per_pixel"] == 550 * 10 / 8


def test_sweep_states_no_power_that_no_core_can_draw():
    """A million photons in each of 1,000 frames a second take 607 times the time there is; it said 0.9 MW."""
    rows = sweep({"fourier-16": Cost(255, 258, 256)}, (550, 1e6), (1000,), (1 << 20,))
    for row in rows:
        assert all((row[name] is None) != row["keeps_up"] for name in NEEDS_TIME), row
    late = next(row for row in rows if not row["keeps_up"])
    assert late["busy"] > 1 and late["frame_time_s"] == pytest.approx(1e6 * 255 * 2.38e-9)
    assert "nan" not in as_csv(rows).lower() and ",," in as_csv(rows)


def test_sweep_and_table_price_the_end_of_the_frame_alike():
    found, load = costs(), Load()
    swept = {row["name"]: row for row in sweep(found, (load.photons,), (load.frames_per_s,), (load.pixels,))}
    for row in table(found):
        columns = row["emulated"]
        assert columns == {name: swept[row["name"]][name] for name in columns}
        joules = columns["frame_end_clocks"] / 3 / 94.6e9
        assert columns["frame_end_uw_energy"] == pytest.approx(1e6 * joules * load.pixels * load.frames_per_s)
    assert swept["raw timestamps"]["frame_end_uw_energy"] == 0


def test_the_slowest_core_of_a_block_decides_how_many_frames_a_second_there_can_be():
    chosen = method("separable-16")
    cost, tables = measured_cost(chosen, tensor("separable-16")), chosen.tables(tensor("separable-16"))
    frame = CoreArray(chosen.program(), (2, 2), tables).frame(np.zeros(0, int), np.zeros(5, int))
    slowest_s = frame.cycles.max() * ChipSpec().clock_s
    for rate, keeps_up in ((1.001 / slowest_s, False), (0.999 / slowest_s, True)):
        row = sweep({"separable": cost}, (0,), (rate,), (4,))[0]
        assert row["busy"] == pytest.approx(rate * slowest_s) and row["keeps_up"] == keeps_up
    assert power(cost, Load()).frame_end_time_s == pytest.approx(slowest_s)


PROLOGUE = """
.space sum, s16, 1
      MOV r1, #3
loop: BNT idle
      RDT r2
      ADDM [sum], r1
      JMP loop
idle: BFE end
      JMP loop
end:  MOV r4, #0
      STH [sum], r4
      HALT
"""


def test_what_comes_before_the_loop_is_paid_once_a_frame():
    """Compare proof, cost and frames: a photon's clocks are what one more photon takes."""
    program = assemble(PROLOGUE)
    cost = cost_of(program, (1, 1), {}, {})
    assert (verify(program).clocks == cost.clocks_per_photon).all()
    for photons in (0, 1, 40):
        _, counters = Core(program).frame(np.arange(photons))
        assert counters.cycles == cost.clocks_per_frame + photons * cost.clocks_per_photon


@pytest.mark.parametrize("bits", [8, 12])
def test_cost_is_of_the_chips_timestamps(bits):
    """A timestamp in the last quarter takes an instruction more."""
    chip = ChipSpec(timestamp_bits=bits)
    program = assemble(PROLOGUE.replace("ADDM", f"BBC r2, #{bits - 1}, s\nBBC r2, #{bits - 2}, s\nMOV r3, #0\ns: ADDM"))
    clocks = verify(program, chip=chip).clocks
    assert len(clocks) == 1 << bits
    assert cost_of(program, (1, 1), {}, {}, chip).clocks_per_photon == clocks.mean()


@pytest.mark.parametrize("bad", [{"photons": -1}, {"frames_per_s": 0}, {"pixels": 0}])
def test_loads_are_checked(bad):
    with pytest.raises(InputError, match="load: "):
        Load(**bad)
