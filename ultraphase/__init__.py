"""The UltraPhase in-pixel processor. So far its published facts and what follows from them in closed form."""

from ultraphase.chip import ChipSpec

__all__ = ["ChipSpec"]
