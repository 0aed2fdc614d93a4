"""`python -m scene2spad.cli COMMAND`."""

from scene2spad.start import script

script()
