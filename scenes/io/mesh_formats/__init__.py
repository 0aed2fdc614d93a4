"""Read mesh files; check what they declare against what is in them: what each format needs beside trimesh.

trimesh reads a text file that was cut, drops a texture that it cannot find, and takes negative indices as Python does.
It passes over what it has no model for: what would then be seen as something else is refused, or put as it reads it.
"""

from __future__ import annotations

from scenes.errors import InputError

# Colours of vertices: fractions of white may exceed 1 a little; any beyond MAX_FRACTION are levels up to MAX_LEVEL.
MAX_FRACTION, MAX_LEVEL = 2, 255


class NotReadError(InputError):
    """A sound file that holds what is not read."""
