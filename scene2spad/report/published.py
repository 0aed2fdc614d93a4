"""Published numbers beside ours, as tables of the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict

from scene2spad.networks.published import printed
from scene2spad.networks.registry import ModelSpec
from scene2spad.report import html
from scene2spad.studies.ablations.plan import sheets_of
from scene2spad.studies.depth_offset.plan import plan_of
from scene2spad.studies.memory import statements
from ultraphase.catalog import PUBLISHED

WORSE = 1.5  # times the published error: its reason is looked for
NOT_MEASURED = "not measured"

RowsOf = Callable[[str], Sequence[dict] | None]
POWER_COLUMNS = ("clocks", "bytes_per_pixel", "rate_kb_per_s", "processing_uw", "readout_uw")


def published_tables(which: str, rows_of: RowsOf) -> list[str]:
    """Return the tables of an item, by what its `published` says; `rows_of` gives a result's rows by its file's
    name."""
    if not which:
        return []
    if which == "power":
        rows = power_rows(rows_of("ultraphase.csv") or ())
        return [html.table(rows, "Published and emulated, program by program")] if rows else []
    if which == "memory":
        return [html.table(statements(), "What S.6 states, and the same from the equations of Table 1")]
    study, _, figure = which.partition("/")
    rows = error_rows(_wanted(study, figure), rows_of(f"{study}-published.csv") or (), far=study == "depth-offset")
    caption = (
        "MAE [mm] over the 5 Middlebury pairs at hand in the published convention, beside the published one over 8 "
        f"scenes and 16 photon levels; marked where ours is more than {WORSE:g} times that"
    )
    return [html.table(rows, caption, most=200)] if rows else []


def _wanted(study: str, figure: str) -> list[ModelSpec]:
    """Every model that the figure has in the paper."""
    if study == "depth-offset":
        return [one for one in plan_of("paper", True).headline if one.seed == 0]
    sheets = [s for s in sheets_of(study, "paper", True) if s.figure.split("-")[0] == figure.split("-")[0]]
    return list(dict.fromkeys(one for sheet in sheets for one in sheet.wanted))


def error_rows(wanted: Iterable[ModelSpec], measured: Sequence[dict], far: bool) -> list[dict[str, object]]:
    """Return a row a measured model: published and ours, as they are and with `far` 7 m farther too."""
    ours, rows = {row.get("model"): row for row in measured}, []
    for one in wanted:
        print_, mine = printed(one), ours.get(one.name)
        if mine is None:
            continue
        row: dict[str, object] = {"design": one.label, "compression": f"{one.compression}x" if one.coded else "none"}
        for place in ("near", "far") if far else ("near",):
            published, found = getattr(print_, f"{place}_mae", None), _number((mine or {}).get(f"{place}_mae_mm_label"))
            row[f"{place} published"] = published
            row[f"{place} ours"] = NOT_MEASURED if found is None else found
            row[f"{place} ours / published"] = _ratio(found, published)
        rows.append({**row, "ours over": (mine or {}).get("of", "")})
    return rows


def _ratio(found: float | None, published: float | None) -> str:
    if found is None or not published:
        return ""
    return f"{found / published:.2f}{' worse' if found > WORSE * published else ''}"


def power_rows(measured: Sequence[dict]) -> list[dict[str, object]]:
    """Return a row a measured program: every published number, and the emulated one."""
    ours = {row.get("name"): row for row in measured}
    rows: list[dict[str, object]] = []
    for name, published in PUBLISHED.items():
        mine = ours.get(name)
        row: dict[str, object] = {"program": name}
        if mine is None:
            continue
        for column in POWER_COLUMNS:
            row[f"{column} published"] = asdict(published)[column]
            row[f"{column} emulated"] = mine.get(f"emulated.{column}", NOT_MEASURED)
        rows.append(row)
    return rows


def _number(text: object) -> float | None:
    try:
        found = float(text)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(found) else None
