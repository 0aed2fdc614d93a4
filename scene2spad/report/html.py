"""HTML for `report`: valid, escaped, without a script and without a reference to anything outside the page."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

GENERATOR = '<meta name="generator" content="scene2spad report">'
# nothing may be loaded, whatever a result's text says
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
SHORT = 30  # rows of a table that is not broken between pages of paper
MANY = 12  # columns from which on its words are broken there
STYLE = """
:root { color-scheme: light; --line: #c9ced6; --soft: #f3f5f8; --bad: #8a1f11; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 76rem; font: 16px/1.5 system-ui, sans-serif; color: #1a1d21;
  background: #fff; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 3rem; border-bottom: 2px solid #1a1d21; padding-bottom: .2rem; }
h3 { margin-top: 2.2rem; }
a { color: #0b4f8a; }
nav { background: var(--soft); padding: .8rem 1.2rem; columns: 22rem 3; }
nav ol { margin: 0; padding-left: 1.4rem; }
nav > ol > li { break-inside: avoid-column; }
figure { margin: 1.2rem 0; }
img { display: block; max-width: 100%; height: auto; border: 1px solid var(--line); background: #fff; }
figcaption, caption { text-align: left; font-size: .86rem; color: #444b55; padding: .35rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .82rem; font-variant-numeric: tabular-nums; }
th, td { border: 1px solid var(--line); padding: .2rem .5rem; text-align: left; vertical-align: top; }
td.n { text-align: right; white-space: nowrap; }
thead th { background: var(--soft); }
.missing, .problem { border-left: 4px solid var(--bad); background: #fdf3f1; padding: .4rem .8rem; }
.first { border-left: 4px solid #0b4f8a; background: var(--soft); padding: .4rem .8rem; }
code { font-size: .88em; overflow-wrap: anywhere; }
@media print {
  @page { size: A4; margin: 14mm 12mm; }
  html { font-size: 9.5pt; }
  body { font-size: 1rem; padding: 0; max-width: none; }
  h2 { break-before: page; margin-top: 0; }
  h2, h3 { break-after: avoid; }
  h2 + *, h3 + *, h3 + p + * { break-before: avoid; }
  figure, tr, .short, .missing, .problem, .first { break-inside: avoid; }
  img { max-height: 225mm; width: auto; border: 0; }
  .wide { overflow: visible; }
  table { font-size: 7pt; max-width: 100%; }
  caption { font-size: 8pt; }
  th, td { padding: .5mm 1mm; overflow-wrap: break-word; }
  .many table { font-size: 5.5pt; }
  .many :is(th, td) { overflow-wrap: anywhere; }
  td.n { white-space: normal; }
  thead { display: table-header-group; }
  nav { columns: 2; }
  a { color: inherit; text-decoration: none; }
}
"""

Entry = tuple[str, str, Sequence[tuple[str, str]]]  # anchor, title, and those beneath


def page(title: str, lead: Iterable[str], contents: Sequence[Entry], body: Iterable[str]) -> str:
    """Return a whole document: title, what comes first, a table of contents, sections."""
    head = (
        f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n{GENERATOR}\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>"
    )
    items = "".join(f"<li>{link(anchor, text)}{_beneath(below)}</li>\n" for anchor, text, below in contents)
    toc = f'<nav aria-label="Contents"><ol>\n{items}</ol></nav>'
    parts = "\n".join([f"<header>\n<h1>{escape(title)}</h1>", *lead, "</header>", toc, "<main>", *body, "</main>"])
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{parts}\n</body>\n</html>\n'


def _beneath(below: Sequence[tuple[str, str]]) -> str:
    return f"<ol>{''.join(f'<li>{link(*one)}</li>' for one in below)}</ol>" if below else ""


def link(anchor: str, text: str) -> str:
    return f'<a href="#{escape(anchor)}">{escape(text)}</a>'


def section(anchor: str, title: str, body: Iterable[str], level: int = 2) -> str:
    """Return a section under a heading of that level; its body is HTML."""
    return f'<section id="{escape(anchor)}">\n<h{level}>{escape(title)}</h{level}>\n' + "\n".join(body) + "\n</section>"


def paragraph(text: str, kind: str = "") -> str:
    marked = f' class="{kind}"' if kind else ""
    return f"<p{marked}>{escape(text)}</p>"


def bullets(items: Iterable[str]) -> str:
    """Return a list of HTML items."""
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def code(text: str) -> str:
    return f"<code>{escape(text)}</code>"


def picture(anchor: str, png: bytes, size: tuple[int, int], alt: str, caption: str) -> str:
    """Return a PNG within the page, as it is."""
    data = base64.b64encode(png).decode("ascii")
    shape = f'width="{size[0]}" height="{size[1]}"'
    image = f'<img src="data:image/png;base64,{data}" {shape} alt="{escape(alt)}">'
    return f'<figure id="{escape(anchor)}">\n{image}\n<figcaption>{escape(caption)}</figcaption>\n</figure>'


def table(rows: Sequence[Mapping[str, object]], caption: str, most: int = 60) -> str:
    """Return rows of any keys, the union of them as columns; at most `most`, and what is left out is said."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f'<th scope="col">{escape(name.replace("_", " "))}</th>' for name in columns)
    lines = "".join(f"<tr>{''.join(_cell(row.get(name)) for name in columns)}</tr>\n" for row in rows[:most])
    rest = f" (the first {most} of {len(rows)} rows)" if len(rows) > most else ""
    kind = f"wide{' short' * (len(rows) <= SHORT)}{' many' * (len(columns) > MANY)}"
    return (
        f'<div class="{kind}"><table>\n<caption>{escape(caption + rest)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}</tbody>\n</table></div>"
    )


def _cell(value: object) -> str:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    kind = ' class="n"' if number else ""
    return f"<td{kind}>{escape(format_value(value))}</td>"


def format_value(value: object) -> str:
    """Return four digits of a number, yes or no, a dash for none or NaN; lists and dictionaries in a line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value == "":
        return "–"
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.4g}".replace("inf", "∞")
    if isinstance(value, Mapping):
        return "; ".join(f"{key}: {format_value(one)}" for key, one in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(format_value, value)) or "–"
    return str(value)
