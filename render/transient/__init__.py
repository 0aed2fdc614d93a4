"""Hold what a camera's pixels see of a pulse over path length, its file and packs. Imports no renderer."""

from render.transient.data import Transient, read_transient, write_transient

__all__ = ["Transient", "read_transient", "write_transient"]
