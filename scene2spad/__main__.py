"""Run the command line by `python -m scene2spad COMMAND`."""

from scene2spad.start import script

script()
