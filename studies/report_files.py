"""What `report` reads: pictures and tables, refused where they are damaged or cut."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from PIL import Image


def read_png(path: Path) -> tuple[bytes, tuple[int, int]]:
    """A PNG's bytes and size; ValueError or OSError where it is none or cut."""
    data = path.read_bytes()
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.verify()
    if not data.rstrip(b"\0").endswith(b"IEND\xaeB`\x82"):
        raise ValueError("its end is missing")
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        return data, image.size


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a table; ValueError where lines are cut."""
    with path.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines, strict=True))
    if any(None in row or None in row.values() for row in rows):
        raise ValueError("rows of other lengths than its head")
    return [{key: _number(text) for key, text in row.items()} for row in rows]


def _number(text: str) -> int | float | str:
    """A table's cell as the number that it spells, if it does."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
