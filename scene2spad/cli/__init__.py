"""The command line: one file a command, its options above what it does. Heavy imports wait inside `run`."""

from scene2spad.cli.main import main

__all__ = ["main"]
