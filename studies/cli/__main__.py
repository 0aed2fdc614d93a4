"""`python -m studies.cli COMMAND`."""

from studies.start import script

script()
