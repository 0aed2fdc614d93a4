"""From a mesh scene to what a single-photon camera records of it, and on to depth, in a few lines of Python.

    import scene2spad as s2s

    transient = s2s.render("living-room", seed=1)
    histogram = s2s.sense(transient, signal=50, background=50, seed=1)
    depth_m = s2s.estimate_depth(histogram, "log-matched")

Arrays are NumPy's, lengths metres and times seconds. Names are imported when they are first used, so that
`import scene2spad` starts neither Mitsuba nor torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from csph import CodingTensor, CompressiveLayer, Design, decode_depth, encode, encode_timestamps, make_coding
    from csph.cards import Card
    from csph.config import ModelConfig, TrainConfig
    from csph.model import DepthModel
    from csph.training import train
    from csph.views import Views, read_views
    from render.settings import RenderSettings
    from render.transient import Transient, read_transient, write_transient
    from scene2spad.chain import (
        coding_tensor,
        depth_errors,
        estimate_depth,
        load_model,
        models,
        render,
        sense,
    )
    from scenes import Ambient, Camera, InputError, Laser, Material, Scene, Surface, Texture
    from scenes.catalog import load_scene
    from spad.budget import Optics
    from spad.histogram import Histogram, read_histogram, write_histogram
    from spad.mat import read_mat, write_mat
    from spad.pulse import Pulse, read_pulse
    from spad.rgbd import transient_from_rgbd
    from spad.sensor import PhotonBudget, Sensor, sensor_by_name
    from ultraphase import ChipSpec, Core, CoreArray, Program, assemble, verify

_MODULE_OF: dict[str, tuple[str, ...]] = {
    "scene2spad.chain": (
        "coding_tensor",
        "depth_errors",
        "estimate_depth",
        "load_model",
        "models",
        "render",
        "sense",
    ),
    "scenes": ("Ambient", "Camera", "InputError", "Laser", "Material", "Scene", "Surface", "Texture"),
    "scenes.catalog": ("load_scene",),
    "render.settings": ("RenderSettings",),
    "render.transient": ("Transient", "read_transient", "write_transient"),
    "spad.sensor": ("PhotonBudget", "Sensor", "sensor_by_name"),
    "spad.pulse": ("Pulse", "read_pulse"),
    "spad.budget": ("Optics",),
    "spad.histogram": ("Histogram", "read_histogram", "write_histogram"),
    "spad.mat": ("read_mat", "write_mat"),
    "spad.rgbd": ("transient_from_rgbd",),
    "csph": (
        "CodingTensor",
        "CompressiveLayer",
        "Design",
        "decode_depth",
        "encode",
        "encode_timestamps",
        "make_coding",
    ),
    "csph.cards": ("Card",),
    "csph.config": ("ModelConfig", "TrainConfig"),
    "csph.model": ("DepthModel",),
    "csph.training": ("train",),
    "csph.views": ("Views", "read_views"),
    "ultraphase": ("ChipSpec", "Core", "CoreArray", "Program", "assemble", "verify"),
}
_HOME = {name: module for module, names in _MODULE_OF.items() for name in names}

__all__ = [  # noqa: RUF022 (in the order of the chain)
    "load_scene",
    "Scene",
    "Surface",
    "Material",
    "Texture",
    "Camera",
    "Laser",
    "Ambient",
    "render",
    "RenderSettings",
    "Transient",
    "read_transient",
    "write_transient",
    "transient_from_rgbd",
    "sense",
    "Sensor",
    "sensor_by_name",
    "Pulse",
    "read_pulse",
    "PhotonBudget",
    "Optics",
    "Histogram",
    "read_histogram",
    "write_histogram",
    "read_mat",
    "write_mat",
    "estimate_depth",
    "depth_errors",
    "coding_tensor",
    "CodingTensor",
    "Design",
    "make_coding",
    "encode",
    "encode_timestamps",
    "decode_depth",
    "CompressiveLayer",
    "models",
    "Card",
    "load_model",
    "DepthModel",
    "ModelConfig",
    "TrainConfig",
    "train",
    "Views",
    "read_views",
    "ChipSpec",
    "Core",
    "CoreArray",
    "Program",
    "assemble",
    "verify",
    "InputError",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        return version("scene2spad")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
