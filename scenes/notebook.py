"""Show objects in notebooks: a table of facts and a grey picture, without matplotlib."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape

import numpy as np

WHITE = 0.99  # quantile of a picture's values that is shown white
SIDE = 256  # pixels that the longer side of a small picture is enlarged to


def html_card(title: str, facts: Mapping[str, object], image: np.ndarray | None = None) -> str:
    """Return HTML of facts as a table, and of an image (H, W) >= 0 in grey beside it."""
    rows = "".join(
        f'<tr style="text-align:left"><th>{escape(str(key))}</th><td>{escape(str(value))}</td></tr>'
        for key, value in facts.items()
    )
    picture = "" if image is None else f'<img alt="{escape(title)}" src="data:image/png;base64,{_grey_png(image)}">'
    return f"<div><b>{escape(title)}</b><table>{rows}</table>{picture}</div>"


def _grey_png(image: np.ndarray) -> str:
    """Return a PNG in base64: values relative to the WHITE quantile of what is lit, display gamma."""
    from PIL import Image

    values = np.nan_to_num(image.astype(float))
    lit = values[values > 0]
    top = float(np.quantile(lit, WHITE)) if lit.size else 1.0
    grey = np.rint(255 * np.clip(values / top, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    factor = max(1, SIDE // max(grey.shape))
    buffer = io.BytesIO()
    Image.fromarray(grey.repeat(factor, axis=0).repeat(factor, axis=1)).save(buffer, format="PNG")
    return base64.b64encode(buffer.getvalue()).decode("ascii")
