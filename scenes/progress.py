"""The type of what long work reports its progress to."""

from __future__ import annotations

from collections.abc import Callable

# what is being done, and which fraction of the whole is done
Progress = Callable[[str, float], None]
