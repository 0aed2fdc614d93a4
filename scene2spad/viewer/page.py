"""One HTML file of a `Content`: script and style stand within it, and its policy forbids every request."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html import escape
from pathlib import Path

import matplotlib
import numpy as np

from scene2spad.report.html import table
from scene2spad.viewer.content import Content, Returns, cube_payload, packed
from scenes.files import whole_file
from scenes.json_types import JsonObject

ROOM = Path(__file__).parent
STOPS = 32  # of each colour scale
PALETTES = {"gray": "gray", "depth": "viridis_r", "error": "magma", "light": "inferno"}
DECADES = 6.0  # of energy below a page's brightest return that are told apart
MAX_POINTS = 20_000
TIME_STEP_NS = 0.02


def write_page(content: Content, path: Path) -> Path:
    """Write the page, whole or not at all."""
    with whole_file(path) as beside:
        beside.write_text(page_html(content), encoding="utf-8")
    return path


def page_html(content: Content) -> str:
    """Return the whole document."""
    script, style = ((ROOM / name).read_text(encoding="utf-8") for name in ("viewer.js", "viewer.css"))
    # a script whose hash is stated is the only one that runs, and nothing is loaded
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{allowed}'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"
    )
    payload = _payload(content)
    data = json.dumps(payload, separators=(",", ":")).replace("</", "<\\/")
    facts = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in content.facts.items())
    notes = "".join(f'<p class="hint">{escape(note)}</p>' for note in content.notes)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="generator" content="scene2spad show">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(content.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f'<header><h1>{escape(content.title)}</h1>\n<dl>{facts}</dl>{notes}<p id="problem" role="alert"></p></header>\n'
        f"<main>\n{''.join(_sections(content, payload))}</main>\n"
        f'<script type="application/json" id="payload">{data}</script>\n<script>{script}</script>\n</body>\n</html>\n'
    )


def _sections(content: Content, payload: JsonObject) -> list[str]:
    """Return the sections of the page that the content fills, in order."""
    markup = (ROOM / "viewer.html").read_text(encoding="utf-8")
    parts = dict(re.findall(r"<!-- (\w+) -->\n(.*?)(?=<!--|\Z)", markup, re.S))
    found = []
    if content.layers:
        found.append(parts["image"])
    if content.cubes:
        plot = parts["plot"].replace("MARKS", _marks(content))
        found += [plot.replace("NOTE", escape(_precision(content, payload["cubes"]))), parts["movie"]]
    if payload["points"] is not None:
        found.append(parts["cloud"])
    for caption, png in content.figures:
        data = base64.b64encode(png).decode("ascii")
        image = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
        found.append(f'<section class="wide"><h2>{escape(caption)}</h2>{image}</section>\n')
    for caption, rows in content.tables:
        found.append(f'<section class="wide scroll">{table(rows, caption, most=2000)}</section>\n')
    if content.text:
        found.append(f'<section class="wide"><pre tabindex="0">{escape(content.text)}</pre></section>\n')
    return found


def _marks(content: Content) -> str:
    """Write the legend: words beside the colours that the script draws in."""
    colours = {"detections": "#8b93a0", "expected": "#0072b2", "light": "#0072b2"}
    named = [(cube.name, colours.get(cube.name, "#0072b2")) for cube in content.cubes]
    if content.returns is not None:
        named += [("direct returns (dots)", "#009e73"), ("indirect returns (squares)", "#d55e00")]
    return "".join(f'<span class="key" style="background:{colour}"></span>{escape(name)}' for name, colour in named)


def _precision(content: Content, cubes: list[JsonObject]) -> str:
    """Say what the page rounds, in words."""
    lines = []
    for part in cubes:
        summed = f", {part['summed']} bins summed" if part["summed"] > 1 else ""
        rounded = ", rounded to 255 steps of its square root" if "rooted" in part else ""
        lines.append(f"{part['name']}: {part['unit']}{summed}{rounded}")
    if content.returns is not None:
        lines.append(f"returns on a logarithmic scale of four decades, {content.returns.note}")
    if content.arrival_ns is not None:
        lines.append("dotted: when light from the true depth arrives")
    return "; ".join(lines) + "."


def _payload(content: Content) -> JsonObject:
    height, width = content.layers[0].values.shape if content.layers else (0, 0)
    ramp = np.linspace(0, 1, STOPS)
    colours = {name: np.rint(255 * matplotlib.colormaps[mpl](ramp)[:, :3]).tolist() for name, mpl in PALETTES.items()}
    layers = [
        {
            "name": layer.name,
            "unit": layer.unit,
            "palette": layer.palette,
            "low": layer.low,
            "high": layer.high,
            "data": packed(layer.values.astype(np.float32)),
        }
        for layer in content.layers
    ]
    return {
        "height": height,
        "width": width,
        "palettes": colours,
        "layers": layers,
        "cubes": [cube_payload(cube) for cube in content.cubes],
        "returns": None if content.returns is None else _returns(content.returns),
        "arrival_ns": None if content.arrival_ns is None else packed(content.arrival_ns.astype(np.float32)),
        "points": _cloud(content),
    }


def _returns(returns: Returns) -> JsonObject:
    """Pack times as differences within a pixel, in steps of at least TIME_STEP_NS, and energies in 254 steps of a
    logarithmic scale of DECADES; 0 is what lies below."""
    last = float(returns.time_ns.max(initial=0))
    step = max(TIME_STEP_NS, last / 65535)
    time = np.rint(returns.time_ns / step).astype(np.int64)
    # differences within a pixel are small numbers, which compress well
    delta = np.diff(time, prepend=0)
    begins = returns.offsets[:-1][np.diff(returns.offsets) > 0]
    delta[begins] = time[begins]
    top = float(returns.energy.max(initial=0)) or 1.0
    with np.errstate(divide="ignore"):
        level = np.rint(255 * (1 + np.log10(returns.energy / top) / DECADES))
    return {
        "sizes": packed(np.diff(returns.offsets).astype(np.uint16)),
        "step_ns": step,
        "time_data": packed(delta.astype(np.uint16)),
        "top": top,
        "decades": DECADES,
        "energy_data": packed(np.clip(np.nan_to_num(level, neginf=0), 0, 255).astype(np.uint8)),
        "direct_data": packed(returns.direct.astype(np.uint8)),
    }


def _cloud(content: Content) -> JsonObject | None:
    if content.points is None or len(content.points) < 2:
        return None
    every = -(-len(content.points) // MAX_POINTS)
    points = content.points[::every]
    distance = np.linalg.norm(points, axis=1)
    low, high = (float(v) for v in np.quantile(distance, (0.01, 0.97)))
    seen = points[distance <= high]
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    radius = float(np.quantile(np.linalg.norm(seen - centre, axis=1), 0.95)) or 1.0
    value = None if content.point_value is None else packed(content.point_value[::every].astype(np.float32))
    return {
        "data": packed(points),
        "light": value,
        "low": low,
        "high": high,
        "centre": centre.tolist(),
        "radius": radius,
        "spacing": float(1.2 * np.sqrt(every) * np.median(distance) / np.sqrt(len(points)) * 0.9),
    }
