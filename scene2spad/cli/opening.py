"""Open a file of any kind that we write, and say what it is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scene2spad.cli.paths import begins, holds_kind, input_file
from scenes.errors import InputError, require
from scenes.files import read_array
from scenes.io.hdf5 import HDF5_SUFFIXES
from scenes.io.hdf5 import MARK as HDF5_MARK
from scenes.io.hdf5 import SIGNATURE as HDF5_SIGNATURE

if TYPE_CHECKING:
    from csph.codes.tensor import CodingTensor
    from render.transient import Transient
    from spad.measurements.histogram import Histogram
    from spad.sensor.model import Sensor

BY_SUFFIX = {
    ".exr": ("transient", "depth"),
    ".npz": ("dense",),
    **dict.fromkeys(HDF5_SUFFIXES, ("histogram", "pack", "dense")),
    ".ply": ("cloud",),
    ".mat": ("histogram",),
    ".safetensors": ("network",),
    ".npy": ("codes",),
    ".toml": ("sensor",),
    ".csv": ("table",),
    ".s": ("program",),
    ".txt": ("text",),
}
EXR_SIGNATURE = b"\x76\x2f\x31\x01"
SEALED = ("transient", "depth", "histogram", "pack", "network")
KNOWN = (
    "a transient or depth map (.exr), a histogram or pack (.h5), a frame (.mat), a checkpoint (.safetensors) or a "
    "model's name, codes (.npy, .txt), a sensor (.toml), a table (.csv), a program (.s, .txt), a dense array "
    "(.npz, .h5), points (.ply), or the folder of a set or a run"
)


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Contents of a depth map's file."""

    depth_m: np.ndarray
    confidence: np.ndarray | None
    meta: dict[str, Any]


def kind_of(path: Path) -> str:
    """Return the kind of a file, of a folder ("set" or "network"), or of a model's name ("network").

    Raises InputError in one line that lists what is known.
    """
    if path.is_dir():
        require((path / "index.jsonl").is_file() or (path / "set.json").is_file() or _is_run(path),
                f"{path}: is a folder, but of no set and of no run; expected {KNOWN}")  # fmt: skip
        return "network" if _is_run(path) else "set"
    if not path.suffix and len(path.parts) == 1 and not path.exists():
        from csph.weights.cards import shipped_model

        try:
            shipped_model(path.name)
        except InputError as error:
            raise InputError(f"{path}: file not found, and {error}") from None
        return "network"
    if path.suffix.lower() == ".mat":
        from spad.formats.mat import PULSE_NAME

        if input_file(path).name.startswith(PULSE_NAME):
            return "pulse"
    kinds = BY_SUFFIX.get(input_file(path).suffix.lower(), ())
    unsealed = path.suffix.lower() == ".mat"
    found = next((kind for kind in kinds if kind not in SEALED or unsealed or holds_kind(path, kind)), None)
    require(path.stat().st_size > 0, f"{path}: the file is empty")
    if found is None:
        raise InputError(f"{path}: expected {KNOWN}")
    require(path.suffix.lower() not in HDF5_SUFFIXES or _is_hdf5(path), f"{path}: is no HDF5 file, expected {KNOWN}")
    return found


def _is_hdf5(path: Path) -> bool:
    """Tell whether a file begins as HDF5 does, or with the mark that ours have before it."""
    return begins(path, re.escape(HDF5_SIGNATURE)) or begins(path, re.escape(HDF5_MARK))


def _is_run(path: Path) -> bool:
    from csph.weights.shipped import RUN_WEIGHTS

    return any((path / f"{name}.safetensors").is_file() for name in RUN_WEIGHTS)


def open_transient(path: Path, kind: str, view: int) -> Transient:
    """Read a transient, or one view of a pack; InputError for a view that is not there."""
    if kind == "transient":
        from render.transient import read_transient

        return read_transient(path)
    from render.transient.packs import read_pack

    pack = read_pack(path)
    require(0 <= view < len(pack), f"{path}: no view {view}, there are 0 to {len(pack) - 1}")
    return pack[view]


def pixel_sensor(name: str | None, path: Path) -> Sensor:
    """Return the sensor that a transient is put into, by name or file (default: reference); InputError for zones."""
    from spad.sensor.files import load_sensor

    found = load_sensor(name or "reference")
    require(found.zones is None, f"{path}: a sensor of zones has no pixels; run `scene2spad sense` first")
    return found.sensor


def open_histogram(path: Path, frame: int = 0) -> Histogram:
    """Read a histogram of ours (.h5), counts that `export` wrote (.npz, .h5), or a frame or capture of the published
    family (.mat)."""
    if path.suffix.lower() == ".mat":
        from spad.formats.mat import read_mat

        return read_mat(path, frame)
    require(not frame, f"{path}: --frame {frame} is for captures (.mat)")
    if _is_dense(path):
        from spad.formats.dense_reader import read_dense

        return read_dense(path)
    from spad.measurements.histogram import read_histogram

    _check_no_other_kind(path)
    return read_histogram(path)


def open_for_depth(path: Path, frame: int = 0) -> Histogram:
    """Read a histogram as `open_histogram` does; InputError, naming the file, for one that cannot tell depth."""
    from spad.estimators.bistatic import check_pointing

    histogram = open_histogram(path, frame)
    try:
        check_pointing(histogram)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return histogram


def _is_dense(path: Path) -> bool:
    """Tell whether a file is a dense export, and no histogram: every .npz, and HDF5 by the names of its arrays."""
    suffix = path.suffix.lower()
    if suffix not in HDF5_SUFFIXES or holds_kind(input_file(path), "histogram"):
        return suffix == ".npz"
    from scene2spad.viewer.exports import is_dense

    return is_dense(path)


def _is_cube(path: Path) -> bool:
    """Tell whether a .npy file holds an array of three dimensions: counts, and no codes."""
    try:
        return read_array(path).ndim == 3
    except InputError:
        return False


def _check_no_other_kind(path: Path) -> None:
    """Raise InputError for a file of another kind of ours, which a histogram's reader would call damaged."""
    kinds = BY_SUFFIX.get(path.suffix.lower(), ("histogram",))
    if "histogram" in kinds:
        return
    if path.suffix.lower() == ".exr":
        kinds = tuple(kind for kind in kinds if holds_kind(path, kind)) or ("picture",)
    if kinds[0] == "codes" and _is_cube(path):
        kinds = ("dense",)
    if kinds[0] == "picture":
        raise InputError(
            f"{path}: {_foreign_exr(path)}, expected a histogram (.h5) or a transient (.exr) of scene2spad"
        )
    from spad.formats.dense_reader import BY_HAND

    cure = {
        "dense": BY_HAND,
        "transient": "; sense it first: `scene2spad sense`",
        "codes": "; `depth` takes them by --codes-file, `compare` by --methods",
        "network": "; `depth` takes it by --checkpoint, `compare` by --methods",
        "depth": "; `show` draws it, `export` makes points of it",
        "cloud": "; `show` draws it",
        "table": " (.h5); a table holds no photon counts of pixels, `show` draws one that scene2spad wrote",
        "sensor": "; `sense` and `depth` take it by --sensor",
        "program": "; `ultraphase` runs it",
    }
    raise InputError(f"{path}: is of kind {kinds[0]}, expected a histogram{cure.get(kinds[0], '')}")


def _foreign_exr(path: Path) -> str:
    """Say what a file is that ends in .exr, and that we did not write."""
    if _is_hdf5(path):
        return "is an HDF5 file under the name of an OpenEXR file; give it the ending .h5"
    if begins(path, re.escape(EXR_SIGNATURE)):
        return "is an OpenEXR picture of another program"
    return "is no OpenEXR file, whatever its name says"


def open_depth(path: Path) -> DepthMap:
    """Read a depth map."""
    from spad.formats.depth_map import read_depth

    return DepthMap(*read_depth(path))


def open_coding(path: Path, kind: str) -> CodingTensor:
    """Read the coding tensor of a .npy file, a checkpoint, a run's folder or a shipped model's name."""
    if kind == "codes":
        from csph.codes.files import read_codes

        return read_codes(path)
    from csph.weights.cards import model_coding

    return model_coding(path)


def transient_of(histogram: Histogram, path: Path, given: Path | None) -> Transient | None:
    """Return the transient that a histogram was sensed from: the one given, or that beside it if its hash agrees.

    Raises InputError where the given one is another.
    """
    wanted = histogram.meta.get("transient", {}).get("sha256")
    source = given or path.with_suffix(".exr")
    if given is None and not (source.is_file() and holds_kind(source, "transient")):
        return None
    kind = kind_of(source if source.is_dir() else input_file(source))
    require(kind == "transient", f"{source}: is of kind {kind}, expected the transient that {path} was sensed from")
    transient = open_transient(source, kind, 0)
    if transient.sha256() == wanted:
        return transient
    require(given is None, f"{given}: is not the transient that {path} was sensed from")
    return None
