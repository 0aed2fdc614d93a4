"""Tables of `study transport` from rows of errors: steps, ranking of codes, conclusions. No rendering here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np

from csph.evaluation.methods import LEVEL_GROUPS, PIXELS, Evaluation, Row
from csph.evaluation.metrics import Interval, paired_difference
from scene2spad.networks.registry import EvaluatedModel
from scene2spad.studies.transport.plan import FIRST, KEPT, LASERS, LATER, OPEN, REVERSED, STEPS
from scenes.json_types import JsonObject

Rows = Mapping[tuple[str, str], Sequence[Row]]  # by laser and step


@dataclass(frozen=True, eq=False)
class Contender:
    """A design and how its codes are decoded; codes of one decoder and compression (1: none) are ranked."""

    subject: EvaluatedModel
    decoder: str
    compression: int

    @property
    def name(self) -> str:
        return self.subject.name


def part_saved(part: float) -> str:
    """Return a part as a percentage, with as many decimals, up to four, as tell it from all."""
    for decimals in range(1, 5):
        if (words := f"{part:.{decimals}%}") != f"{1:.{decimals}%}":
            return words
    return "100%"


def order(interval: Interval) -> int | None:
    """Return -1 where the first is better, 1 where the second is, None where the interval holds 0 or is not known."""
    return -1 if interval.high < 0 else 1 if interval.low > 0 else None


def judged(before: Interval, after: Interval) -> str:
    """Return whether two codes stay in order from one step to another."""
    first, second = order(before), order(after)
    if first is None or second is None:
        return OPEN
    return KEPT if first == second else REVERSED


def _mine(rows: Sequence[Row], name: str, levels: str) -> dict[str, np.ndarray]:
    return Evaluation(list(rows)).values([name], levels=levels)


def ranking(rows: Rows, contenders: Sequence[Contender]) -> list[JsonObject]:
    """Return every pair of codes of one decoder and compression: the paired difference of MAE [mm], first - second,
    with RGB-D rates and at each later step, how far it moved, and whether the two stay in order; 95 % intervals over
    scenes."""
    coded = [c for c in contenders if c.compression > 1]
    kinds = groupby(sorted(coded, key=_kind), key=_kind)
    pairs = [pair for _, members in kinds for pair in combinations(members, 2)]
    found = []
    for laser in LASERS:
        for levels in LEVEL_GROUPS:
            if not any(_mine(rows[laser, FIRST], c.name, levels) for c in coded):
                continue
            values = {(step, c.name): _mine(rows[laser, step], c.name, levels) for step in STEPS for c in coded}
            for first, second in pairs:
                common = {"laser": laser, "levels": levels, "decoder": first.decoder, "compression": first.compression}
                common |= {"first": first.name, "second": second.name}
                found += [{**common, **one} for one in _pair(values, first.name, second.name)]
    return found


def _kind(contender: Contender) -> tuple[str, int]:
    return contender.decoder, contender.compression


def _pair(values: Mapping[tuple[str, str], dict[str, np.ndarray]], first: str, second: str) -> Iterator[JsonObject]:
    gaps = {
        step: {scene: mine - values[step, second][scene] for scene, mine in values[step, first].items()}
        for step in STEPS
    }
    nothing = {scene: np.zeros_like(gap) for scene, gap in gaps[FIRST].items()}
    before = paired_difference(gaps[FIRST], nothing)
    for step in LATER:
        after, moved = paired_difference(gaps[step], nothing), paired_difference(gaps[step], gaps[FIRST])
        common: JsonObject = {"step": step, "verdict": judged(before, after)}
        for name, interval in (("rgbd", before), ("here", after), ("moved", moved)):
            common |= {f"{name}_mm": interval.mean, f"{name}_low": interval.low, f"{name}_high": interval.high}
        yield common


def conclusions(ranked: Sequence[JsonObject]) -> list[JsonObject]:
    """Return by laser, step and photon levels: whether what was added up to there changes the ranking of codes.

    It does where one pair is decidedly reversed, it does not where all are decidedly kept, and is else not decided.
    The intervals are of each pair by itself: of many pairs some are wrong by chance.
    """
    found = []
    for laser, step, levels in dict.fromkeys((r["laser"], r["step"], r["levels"]) for r in ranked):
        mine = [r for r in ranked if (r["laser"], r["step"], r["levels"]) == (laser, step, levels)]
        count = {verdict: sum(r["verdict"] == verdict for r in mine) for verdict in (KEPT, REVERSED, OPEN)}
        changes = "changes" if count[REVERSED] else "does not change" if count[KEPT] == len(mine) else OPEN
        common = {"laser": laser, "step": step, "levels": levels, "ranking": changes, "pairs": len(mine)}
        moved = sum(order(Interval(r["moved_mm"], r["moved_low"], r["moved_high"])) is not None for r in mine)
        turned = [_reversal(r) for r in mine if r["verdict"] == REVERSED]
        counted = {verdict.replace(" ", "_"): number for verdict, number in count.items()}
        found.append({**common, **counted, "gap_moved": moved, "turned": turned})
    return found


def _reversal(r: JsonObject) -> str:
    before, after = ("{:+.1f} ({:+.1f} to {:+.1f}) mm".format(*(r[f"{name}_{part}"] for part in ("mm", "low", "high")))
                     for name in ("rgbd", "here"))  # fmt: skip
    return f"{r['first']} - {r['second']}: {before} with RGB-D rates, {after}"


def summary(rows: Rows, contenders: Sequence[Contender]) -> list[JsonObject]:
    """Return MAE [mm] of every design at each laser and step with its interval over scenes, and its change by that
    step."""
    found = []
    for laser in LASERS:
        before: Sequence[Row] | None = None
        for step in STEPS:
            here = rows[laser, step]
            for one in contenders:
                common = {"laser": laser, "step": step, "design": one.name, "decoder": one.decoder,
                        "compression": one.compression}  # fmt: skip
                found += [{**common, **line} for line in _lines(here, before, one.name)]
            before = here
    return found


def _lines(here: Sequence[Row], before: Sequence[Row] | None, name: str) -> Iterator[JsonObject]:
    for levels in LEVEL_GROUPS:
        for pixels in PIXELS:
            values = Evaluation(list(here))
            interval = values.interval([name], pixels, levels)
            if interval is None:
                continue
            line = {"levels": levels, "pixels": pixels, "mae_mm": interval.mean, "mae_low": interval.low,
                    "mae_high": interval.high}  # fmt: skip
            change = Interval(*3 * (math.nan,))
            if before is not None:
                mine = [part.values([name], pixels, levels) for part in (values, Evaluation(list(before)))]
                change = paired_difference(*mine)
            yield {**line, "change_mm": change.mean, "change_low": change.low, "change_high": change.high}
