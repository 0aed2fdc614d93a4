"""Depth maps of networks that an evaluation keeps until it ends: one that was stopped goes on from there."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from csph.evaluation.methods import Method
from csph.networks.checkpoint import weights_sha256
from csph.networks.model import DepthModel
from scene2spad.networks.training import network_method
from scenes.errors import InputError
from scenes.files import link_target, read_arrays, whole_file
from spad.measurements.histogram import Histogram

log = logging.getLogger("scene2spad")


class Unfinished:
    """The folder of an evaluation that has not ended: estimates of its networks, and the maps that are asked for.

    Photons are drawn again, which is quick, and an estimate is known again by its network and all of its histogram:
    those that an evaluation with other options has left do no harm. `taken` counts those that were kept.
    """

    def __init__(self, folder: Path) -> None:
        self.maps, self.taken = folder / "maps", 0
        self._folder, self._estimates = folder, folder / "estimates"
        if self.maps.is_dir():
            shutil.rmtree(self.maps)  # perhaps of other methods and levels, and soon written again

    def method(self, model: DepthModel, overflows: list[int], **reading: Any) -> Method:
        """Return `network_method`, which estimates no histogram again of which the folder holds the depth."""
        words = [weights_sha256(model), asdict(model.config), reading]
        digest = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()
        estimate = network_method(model, overflows=overflows, **reading)

        def method(histogram: Histogram) -> np.ndarray:
            path = self._estimates / f"{_digest(digest, histogram)}.npz"
            if path.is_file():
                found = read_arrays(path)
                self.taken += 1
                overflows.append(int(found["overflows"]))
                return found["depth_m"]
            depth_m = estimate(histogram)
            self._estimates.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as beside:
                np.savez(beside, depth_m=depth_m, overflows=overflows[-1])
            return depth_m

        return method

    def say(self) -> None:
        """Log how many depth maps were those of an evaluation that was stopped, if any were."""
        if self.taken:
            log.info("%d depth maps of networks are those of an evaluation that was stopped", self.taken)

    def end(self, maps: Path | None = None) -> None:
        """Remove what was kept, and move the maps to their place; InputError where that cannot be written."""
        shutil.rmtree(self._estimates, ignore_errors=True)
        try:
            if maps is not None:
                place = link_target(maps)
                if place.is_dir():
                    place.rmdir()  # `check_free` has found it empty
                shutil.move(self.maps, place)
            if self._folder.is_dir() and not any(self._folder.iterdir()):
                self._folder.rmdir()
        except OSError as error:
            raise InputError(f"{maps or self._folder}: cannot be written ({error.strerror or error})") from None


def _digest(method: str, histogram: Histogram) -> str:
    words = [method, histogram.sha256(), histogram.meta]
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:32]
