"""From a mesh scene to what a single-photon camera records of it, and on to depth, in a few lines of Python.

    import scene2spad as s2s

    transient = s2s.render("living-room", seed=1)
    histogram = s2s.sense(transient, signal=50, background=50, seed=1)
    depth_m = s2s.estimate_depth(histogram, "log-matched")

Arrays are NumPy's, lengths metres and times seconds. Names are imported when they are first used, so that
`import scene2spad` starts neither Mitsuba nor torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from csph import CodingTensor, CompressiveLayer, Design, decode_depth, encode, encode_timestamps, make_coding
    from csph.codes.physics import deepinv_physics
    from csph.networks.config import ModelConfig, TrainConfig
    from csph.networks.model import DepthModel
    from csph.training.loop import train
    from csph.training.views import Views, read_views
    from csph.weights.cards import Card
    from render.mitsuba_integrator import register_integrator
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
    from scenes.library.catalog import load_scene
    from scenes.placing import Placing
    from spad.formats.dense import dense, write_dense
    from spad.formats.dense_reader import read_dense
    from spad.formats.mat import read_mat, write_mat
    from spad.formats.ply import points, write_ply
    from spad.formats.rgbd import transient_from_rgbd
    from spad.measurements.histogram import Histogram, read_histogram, write_histogram
    from spad.sensor.budget import Optics
    from spad.sensor.model import PhotonBudget, Sensor
    from spad.sensor.pulse import Pulse, read_pulse
    from spad.sensor_names import sensor_by_name
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
    "scenes.library.catalog": ("load_scene",),
    "scenes.placing": ("Placing",),
    "render.mitsuba_integrator": ("register_integrator",),
    "render.settings": ("RenderSettings",),
    "render.transient": ("Transient", "read_transient", "write_transient"),
    "spad.sensor.model": ("PhotonBudget", "Sensor"),
    "spad.sensor_names": ("sensor_by_name",),
    "spad.sensor.pulse": ("Pulse", "read_pulse"),
    "spad.sensor.budget": ("Optics",),
    "spad.formats.dense": ("dense", "write_dense"),
    "spad.formats.dense_reader": ("read_dense",),
    "spad.formats.ply": ("points", "write_ply"),
    "spad.measurements.histogram": ("Histogram", "read_histogram", "write_histogram"),
    "spad.formats.mat": ("read_mat", "write_mat"),
    "spad.formats.rgbd": ("transient_from_rgbd",),
    "csph": (
        "CodingTensor",
        "CompressiveLayer",
        "Design",
        "decode_depth",
        "encode",
        "encode_timestamps",
        "make_coding",
    ),
    "csph.codes.physics": ("deepinv_physics",),
    "csph.weights.cards": ("Card",),
    "csph.networks.config": ("ModelConfig", "TrainConfig"),
    "csph.networks.model": ("DepthModel",),
    "csph.training.loop": ("train",),
    "csph.training.views": ("Views", "read_views"),
    "ultraphase": ("ChipSpec", "Core", "CoreArray", "Program", "assemble", "verify"),
}
__all__ = [  # noqa: RUF022 (in the order of the chain)
    "load_scene",
    "Placing",
    "Scene",
    "Surface",
    "Material",
    "Texture",
    "Camera",
    "Laser",
    "Ambient",
    "render",
    "RenderSettings",
    "register_integrator",
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
    "dense",
    "write_dense",
    "read_dense",
    "points",
    "write_ply",
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
    "deepinv_physics",
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


_import_name, _names = lazy_names(__name__, _MODULE_OF)


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for (PEP 562)."""
    if name == "__version__":
        from scenes.io.versions import installed_version

        return installed_version("scene2spad")
    return _import_name(name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
