"""Define the trained models that `study power` puts on the chip. Plain data."""

from __future__ import annotations

from scene2spad.studies.chip.plan import MAIN, OTHERS, TRAINED_FOR_CHIP

WANTED = (*MAIN, *TRAINED_FOR_CHIP, *OTHERS)
