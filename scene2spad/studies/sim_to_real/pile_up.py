"""Does the exact law of pile-up explain a measured pulse at high flux? From the pulse at low flux, by one number.

A synchronous detector counts each cycle's first photon. A free-running one whose dead time ends between two pulses
counts n_k = (1 - exp(-mu_k)) (armed - sum_(j<k) n_j): the same shape, so that one prediction serves both.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np

from scene2spad.plots.figures import plt, save
from scenes.files import read_arrays
from spad.detection.laws import first_photon_masses

Row = dict[str, str | float]
LOW, HIGH = ("synchronous_low_flux", "free_low_flux"), "free_high_flux"
STEP_PS = 8.0
BEFORE, AFTER = 60, 300  # steps around the peak that hold both lobes
SHIFTS = np.arange(-12, 12.01, 0.25)  # steps: the recordings have no common zero
FLUXES = (0.0, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)  # detections a cycle, all of them searched
COMPRESSIONS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)


def measured_pulses() -> dict[str, np.ndarray]:
    """Return the shipped pulses by name, (BEFORE + AFTER,) each, of unit sum; the files begin at the peak and wrap."""
    path = Path(str(files("scene2spad.datasets") / "pulses" / "cvpr2022-8ps.npz"))
    held = read_arrays(path, "pulse file")
    cut = {name: np.concatenate((held[name][-BEFORE:], held[name][:AFTER])) for name in (*LOW, HIGH)}
    return {name: pulse / pulse.sum() for name, pulse in cut.items()}


def piled_up(pulse: np.ndarray, flux: float) -> np.ndarray:
    """Return the pulse (T,), unit sum, that a detector records at `flux` detections a cycle, by the first-photon
    law."""
    if not flux:
        return pulse
    counted = first_photon_masses(flux * pulse[None] / pulse.sum())[0, :-1]
    return counted / counted.sum()


def compressed(pulse: np.ndarray, strength: float) -> np.ndarray:
    """Return the pulse with full bins compressed, n / (1 + strength n / max n): a description, no law."""
    found = pulse / (1 + strength * pulse / pulse.max())
    return found / found.sum()


def misfit(measured: np.ndarray, predicted: np.ndarray) -> float:
    """Return the nRMSE of the shape, over the best scale and shift."""
    steps, size = np.arange(len(predicted)), np.linalg.norm(measured)
    moved = [np.interp(steps - shift, steps, predicted) for shift in SHIFTS]
    return min(float(np.linalg.norm(measured - one * (one @ measured) / (one @ one)) / size) for one in moved)


def second_lobe(pulse: np.ndarray) -> float:
    """Return the share of a pulse that its second lobe holds, which a first-photon detector sees less of."""
    return float(pulse[BEFORE + 70 :].sum() / pulse.sum())


def pile_up_rows() -> list[Row]:
    """Return the misfit of the measured pulse at high flux, a row a pulse at low flux and a law's number."""
    pulses = measured_pulses()
    rows: list[Row] = []
    for name in LOW:
        for law, apply, numbers in (("first photon", piled_up, FLUXES), ("compression", compressed, COMPRESSIONS)):
            for number in numbers:
                predicted = apply(pulses[name], number)
                rows.append(
                    {
                        "from": name,
                        "law": law,
                        "number": number,
                        "nrmse": misfit(pulses[HIGH], predicted),
                        "second_lobe": second_lobe(predicted),
                        "second_lobe_measured": second_lobe(pulses[HIGH]),
                    }
                )
    return rows


def best_of(rows: Sequence[Row]) -> list[Row]:
    """Return the row of the least misfit for each pulse and law."""
    keys = dict.fromkeys((row["from"], row["law"]) for row in rows)
    return [min((r for r in rows if (r["from"], r["law"]) == key), key=lambda r: float(r["nrmse"])) for key in keys]


def draw_pile_up(path: Path) -> Path:
    """Draw the measured pulses, and what the first-photon law makes of the one at low flux."""
    pulses = measured_pulses()
    time = (np.arange(BEFORE + AFTER) - BEFORE) * STEP_PS / 1e3
    figure, panel = plt.subplots(figsize=(8, 4), layout="constrained")
    for name, style in ((LOW[0], "k-"), (LOW[1], "k:"), (HIGH, "C1-")):
        panel.plot(time, pulses[name] / pulses[name].max(), style, lw=1.2, label="measured: " + name.replace("_", " "))
    for flux, colour in ((0.5, "C0"), (1.5, "C2")):
        predicted = piled_up(pulses[LOW[0]], flux)
        panel.plot(time, predicted / predicted.max(), "--", color=colour, lw=1, label=f"law: {flux:g} a cycle")
    panel.set_xlabel("time after the peak [ns]")
    panel.set_ylabel("counts over the fullest step")
    panel.grid(alpha=0.3)
    panel.legend(fontsize=8)
    return save(figure, path)
