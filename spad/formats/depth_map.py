"""A depth map's file: one OpenEXR with Z [m], `confidence` where it is known, and what made it."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from render.transient.exr_files import write_exr
from scenes.errors import InputError
from scenes.files import ATTRIBUTE, check_seal, open_seal, seal, whole_file
from scenes.io.textures import read_flat_exr
from scenes.json_types import JsonObject


def write_depth(depth_m: np.ndarray, path: Path, meta: JsonObject, confidence: np.ndarray | None = None) -> None:
    """Write a depth map (H, W) [m], and beside it how sure its method is of it (`confidence`, in [0, 1])."""
    import OpenEXR

    layers = {"Z": depth_m} if confidence is None else {"Z": depth_m, "confidence": confidence}
    channels = {name: np.ascontiguousarray(layer, dtype=np.float32) for name, layer in layers.items()}
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        ATTRIBUTE: seal({**meta, "unit": "m"}, "depth", _sha256(channels)),
    }
    with whole_file(path) as beside:
        write_exr(OpenEXR.File(header, channels), beside)


def read_depth(path: Path) -> tuple[np.ndarray, np.ndarray | None, JsonObject]:
    """Read a depth map, its confidence or None, and its metadata; check its hash.

    Raises InputError in one line for a missing, foreign, truncated or altered file.
    """
    path = Path(path)
    channels, header = read_flat_exr(path, "file")
    try:
        sealed = header.get(ATTRIBUTE)
        if not isinstance(sealed, str) or "Z" not in channels:
            raise InputError("no depth map of scene2spad")
        meta, sha256 = open_seal(sealed, "depth")
        meta = check_seal(meta, sha256, _sha256(channels))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return channels["Z"], channels.get("confidence"), meta


def _sha256(channels: dict[str, np.ndarray]) -> str:
    """Hash the depth, and the confidence where there is one."""
    layers = [channels[name] for name in ("Z", "confidence") if name in channels]
    return hashlib.sha256(b"".join(np.ascontiguousarray(layer).tobytes() for layer in layers)).hexdigest()
