"""Run the same commands on two trees and compare what they write, number by number.

    python tools/same_results.py OLD NEW [--only NAME ...] [--out FOLDER] [--kept]

OLD and NEW are folders of two checkouts; both run with the Python that runs this script. Arrays must be equal bit for
bit. Fields that name a version, a schema, a checksum, a folder or a time may differ. Exit status 1 where anything else
does, with a line for each difference. Made for changes that move and rename code and must change nothing else.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

# Of metadata: what two versions of the same result may disagree about.
MAY_DIFFER = {"schema", "versions", "version", "sha256", "seconds", "timings", "out", "file", "path"}
MODULES = ("scene2spad.cli", "studies.cli")  # where the command line lies, the newest first
MODELS = ("learned-256x4x4-128x-s0", "fourier-1024x1x1-128x-s0", "none-s0")

# Name -> commands, run in an empty folder one after the other.
RUNS: dict[str, tuple[str, ...]] = {
    "render direct": ("render plane --bounces 1 --width 48",),
    "render indirect": ("render gallery --width 48 --bounces 4 --spp 16 --seed 1",),
    "render filtered": ("render living-room --width 48 --filter --bounces 4 --spp 16",),
    "render ambient": ("render rooms/test/0 --width 48 --bounces 2 --spp 16 --ambient on --ambient-spp 8 --out a.exr",),
    "render offset": ("render gallery --width 32 --bounces 1 --offset 7 --offset-mode rigid",),
    "sense": (
        "render gallery --width 32 --bounces 1",
        "sense gallery.exr --seed 2 --out poisson.h5 --model poisson",
        "sense gallery.exr --seed 2 --out first.h5 --model first-photon",
        "sense gallery.exr --seed 2 --out free.h5 --model free-running --dead-time 5e-8 --reset free-running",
        "sense gallery.exr --seed 2 --out talk.h5 --crosstalk 0.02 --hot-pixels 0.01 --dead-pixels 0.01",
        "sense gallery.exr --seed 2 --out mat.h5 --sensor linospad --export mat",
    ),
    "depth": (
        "render gallery --width 32 --height 32 --bounces 1",
        "sense gallery.exr --seed 2",
        *(f"depth gallery.h5 --method {m}" for m in ("argmax", "matched", "log-matched", "correlation", "coates")),
        *(f"depth gallery.h5 --method compressive --code {c} --codes 16" for c in ("fourier", "gray", "coarse")),
        *(f"depth gallery.h5 --method network --model {m} --decoder soft-argmax --out {m}.exr" for m in MODELS),
        f"depth gallery.h5 --method network --model {MODELS[0]} --decoder soft-argmax --int8 --out int8.exr",
    ),
    "dataset": ("dataset rooms --count 12 --width 16 --height 16 --bounces 1 --workers 2 --out set --pack set.h5",),
    "evaluate": (
        "dataset rooms --count 6 --width 16 --height 16 --bounces 1 --out set --pack set.h5",
        f"evaluate {' '.join(MODELS)} --set set.h5 --baselines log-matched fourier-8 --views 2"
        " --decoder soft-argmax --out evaluated",
    ),
    "train": ("train --preset smoke --design learned --block 256 4 4 --compression 128 --threads 1 --out run",),
    "ultraphase": ("ultraphase table", "ultraphase verify fourier-8"),
    "study tensors": ("study tensors --out tensors",),
    "study memory": ("study memory --out memory",),
    "study codes": ("study codes --width 16 --height 16 --out codes",),
}


def main() -> int:
    """Run everything on both trees and compare; 0 if all results are the same."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="checkout before the change")
    parser.add_argument("new", type=Path, help="checkout after the change")
    parser.add_argument("--only", nargs="+", choices=[*RUNS], default=[*RUNS], help="these runs alone")
    parser.add_argument("--out", type=Path, default=Path("out/same-results"), help="folder for what both write")
    parser.add_argument("--kept", action="store_true", help="compare what an earlier call wrote; run nothing")
    chosen = parser.parse_args()
    found = []
    for name in chosen.only:
        folders = [chosen.out / side / name.replace(" ", "-") for side in ("old", "new")]
        for tree, folder in zip((chosen.old, chosen.new), folders, strict=True):
            if not chosen.kept:
                run_all(tree.resolve(), RUNS[name], folder)
        differences = list(compared(*folders))
        found += differences
        files = sum(1 for path in folders[0].rglob("*") if path.is_file())
        print(f"{name}: {files} files, {len(differences) or 'no'} differences", flush=True)
        for line in differences:
            print(f"  {line}")
    return 1 if found else 0


def run_all(tree: Path, commands: tuple[str, ...], folder: Path) -> None:
    """Run commands of a tree in a folder that is emptied before; what each prints with --json is kept beside."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    found = (one for one in MODULES for end in ("", ".py") if (tree / f"{one.replace('.', '/')}{end}").exists())
    module = next(found)
    program = f"import sys; from {module} import main; sys.exit(main(sys.argv[1:]))"
    surroundings = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    for number, command in enumerate(commands):
        words = [sys.executable, "-c", program, *in_words_of(module, command.split(), tree), "--json"]
        done = subprocess.run(words, cwd=folder, env=surroundings, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{tree}: {command}: exit status {done.returncode}\n{done.stderr[-2000:]}")
        (folder / f"printed-{number}.json").write_text(done.stdout.splitlines()[-1] + "\n")


def in_words_of(module: str, words: list[str], tree: Path) -> list[str]:
    """Return a command in the words of an older command line: before the move, models had no names and one decoder."""
    if module != "studies.cli":
        return words
    if "--decoder" in words:
        at = words.index("--decoder")
        words = words[:at] + words[at + 2 :]
    weights = tree / "csph" / "weights"  # flat in older trees, today a folder a model
    files = {name: str(weights / f"{name}.safetensors") for name in MODELS}
    return [files.get(word, "--checkpoint" if word == "--model" and "network" in words else word) for word in words]


def compared(old: Path, new: Path) -> Iterator[str]:
    """Say every difference between the files of two folders."""
    names = [{path.relative_to(root) for path in root.rglob("*") if path.is_file()} for root in (old, new)]
    for name in sorted(names[0] ^ names[1]):
        yield f"{name}: only in the {'old' if name in names[0] else 'new'} tree"
    for name in sorted(names[0] & names[1]):
        if name.name == "timings.jsonl":
            continue
        first, second = (dict(numbers_of(root / name)) for root in (old, new))
        for key in sorted(first.keys() ^ second.keys()):
            yield f"{name}: {key} is only in the {'old' if key in first else 'new'} file"
        for key in sorted(first.keys() & second.keys()):
            if not same(first[key], second[key]):
                yield f"{name}: {key} differs"


def same(first: Any, second: Any) -> bool:
    """Return whether two values are equal bit for bit; arrays with NaN at the same places are."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        if first.dtype.hasobject:  # MATLAB structures: their bytes would be addresses
            return first.shape == second.shape and all(map(same, first.ravel().tolist(), second.ravel().tolist()))
        return first.dtype == second.dtype and first.shape == second.shape and bool(first.tobytes() == second.tobytes())
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return type(first) is type(second) and (first == second or (first != first and second != second))


def numbers_of(path: Path) -> Iterator[tuple[str, Any]]:
    """Every array and every number of a file, each under its place in it."""
    readers = {
        ".exr": _exr, ".h5": _hdf5, ".safetensors": _safetensors, ".json": _json, ".csv": _csv, ".png": _png,
        ".npy": lambda path: iter([("array", np.load(path))]), ".mat": _mat,
    }  # fmt: skip
    if path.suffix in readers:
        yield from readers[path.suffix](path)
    elif path.suffix != ".ckpt":  # what a run needs to go on: its weights are compared
        yield "bytes", path.read_bytes()


def _flat(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, item in value.items():
            if not any(key == word or key.startswith("seconds") for word in MAY_DIFFER):
                yield from _flat(item, f"{place}.{key}")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _flat(item, f"{place}[{number}]")
    else:
        yield place, value


def _json(path: Path) -> Iterator[tuple[str, Any]]:
    yield from _flat(json.loads(path.read_text()), "")


def _csv(path: Path) -> Iterator[tuple[str, Any]]:
    with path.open(newline="") as lines:
        for number, row in enumerate(csv.DictReader(lines)):
            for key, value in row.items():
                if "seconds" not in key:
                    yield f"{number}.{key}", value


def _png(path: Path) -> Iterator[tuple[str, Any]]:
    from PIL import Image

    with Image.open(path) as image:
        yield "pixels", np.asarray(image)


def _exr(path: Path) -> Iterator[tuple[str, Any]]:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        for part in file.parts:  # in any order
            for name, channel in part.channels.items():
                pixels = channel.pixels
                if pixels.dtype == object:  # deep: an array a pixel, None where there is no sample
                    empty = np.zeros(0, np.float32)
                    pixels = np.concatenate([empty if one is None else np.asarray(one).ravel() for one in pixels.flat])
                yield name, np.ascontiguousarray(pixels)
            meta = part.header.get("scene2spad")
            if meta:
                yield from _flat(json.loads(meta), "scene2spad")


def _hdf5(path: Path) -> Iterator[tuple[str, Any]]:
    import h5py

    found: list[tuple[str, Any]] = []

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found.append((name, item[()]))

    with h5py.File(path) as file:
        file.visititems(keep)
        for key, value in file.attrs.items():
            found += list(_flat(json.loads(value), key)) if isinstance(value, str) and value[:1] == "{" else []
    yield from found


def _safetensors(path: Path) -> Iterator[tuple[str, Any]]:
    from safetensors.numpy import load_file

    yield from load_file(path).items()


def _mat(path: Path) -> Iterator[tuple[str, Any]]:
    import scipy.io
    import scipy.sparse

    for name, value in scipy.io.loadmat(path).items():
        if not name.startswith("__"):
            yield name, value.toarray() if scipy.sparse.issparse(value) else value


if __name__ == "__main__":
    sys.exit(main())
