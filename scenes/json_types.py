"""Types of what JSON holds: metadata of files, rows of results. Every reader checks the keys that it uses."""

from typing import Any, TypeAlias

# An object as `json.loads` returns it. Its values stay unchecked: a union of what JSON holds would have every reader
# of `meta["camera"]["fov_deg"]` ask for a type that the file's seal and schema have settled already.
JsonObject: TypeAlias = dict[str, Any]
