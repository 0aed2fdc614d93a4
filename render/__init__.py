"""Scene -> Transient. `render.transient` imports no renderer; `render.engine` is where Mitsuba comes in.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from render.engine import render
    from render.settings import RenderSettings
    from render.transient.data import Transient, read_transient, write_transient

__all__ = ["RenderSettings", "Transient", "read_transient", "render", "write_transient"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "render.engine": ("render",),
        "render.settings": ("RenderSettings",),
        "render.transient.data": ("Transient", "read_transient", "write_transient"),
    },
)
