"""The command line: one file a command, in rooms by stage, its options first. Heavy imports wait inside `run`."""

from scene2spad.cli.main import main

__all__ = ["main"]
