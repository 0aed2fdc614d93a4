"""Laws that the exposures of an evaluation are drawn by, and what their plans say, once for all of them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import NamedTuple

from spad.detection.detect import Model, choose_model, mean_pixel_law
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

BY_DEFAULT = "model: poisson as asked"  # begins the line that says nothing where nobody asked


def asked_law(law: Model | None, sensor: Sensor, budget: PhotonBudget) -> Model:
    """Return the law to ask `sense` for: the one given, or, for None, poisson up to 1 % detections a cycle in the mean
    pixel, which networks are trained by, and auto above."""
    if law is not None:
        return law
    return "poisson" if mean_pixel_law(sensor, budget)[0] == "poisson" else "auto"


class PlanLine(NamedTuple):
    """A line of the plans: of how many exposures one alike was, and the words, pile-up and place of that with most."""

    exposures: int
    words: str
    pile_up: float
    where: str


@dataclass
class Plans:
    """Collect what the plans of an evaluation's exposures say: lines that differ in numbers alone are one.

    exposures  how many there were
    lines      by the line without its numbers
    left_out   exposures by the Poisson law for which `auto` would have taken another, whose pile-up is left out
    """

    exposures: int = 0
    lines: dict[str, PlanLine] = field(default_factory=dict)
    left_out: PlanLine | None = None

    def add(self, histogram: Histogram, where: str, by_default: bool) -> None:
        """Count the plan of one exposure; `by_default`: nobody asked for its law."""
        meta, self.exposures = histogram.meta, self.exposures + 1
        pile_up = float(meta["pile_up"])
        if meta["model"] == "poisson" and choose_model("auto", pile_up, histogram.sensor)[0] != "poisson":
            self.left_out = _counted(self.left_out, "", pile_up, where)
        for words in meta["plan"]:
            if by_default and words.startswith(BY_DEFAULT):
                continue
            kind = re.sub(r"\d\S*", "#", words)
            self.lines[kind] = _counted(self.lines.get(kind), words, pile_up, where)

    def messages(self) -> list[str]:
        """Return every line, how many exposures had it where not all had, and of which one its numbers are, if it has
        any: of the one with most pile-up."""
        if self.exposures == 1:
            return [line.words for line in self.lines.values()]
        return [self._message(line) for line in self.lines.values()]

    def _message(self, line: PlanLine) -> str:
        some = [f"{line.exposures} of {self.exposures} exposures"] if line.exposures < self.exposures else []
        notes = some + ([f"numbers of {line.where}"] if re.search(r"\d", line.words) else [])
        return f"{line.words} ({', '.join(notes)})" if notes else line.words


def _counted(line: PlanLine | None, words: str, pile_up: float, where: str) -> PlanLine:
    """Return a line counted once more, with these words where they are of more pile-up than it had."""
    exposures = 1 if line is None else line.exposures + 1
    if line is None or pile_up > line.pile_up:
        return PlanLine(exposures, words, pile_up, where)
    return line._replace(exposures=exposures)
