"""`python -m studies.cli COMMAND`."""

from studies.cli import script

script()
