"""Single-photon compressive histograms: coding tensors, encoding, decoding.

Names are imported when they are first used: modules without torch, `csph.codes.waves`, can be imported alone.

Examples
--------
A network that finds depth from 8 codes of every 16 bins x 2 x 2 pixels is trained for two steps, on walls within the
1 m that 64 bins of 100 ps reach. A real run takes thousands of steps, and the views of `read_views`:

>>> import tempfile
>>> import numpy as np
>>> import scene2spad as s2s
>>> image = np.ones((8, 8))
>>> walls = [s2s.transient_from_rgbd(depth_m * image, image, 0 * image) for depth_m in (0.3, 0.6)]
>>> views = s2s.Views(tuple(walls), ("near", "far"))
>>> sensor = s2s.Sensor(bins=64, bin_width_s=100e-12)
>>> model = s2s.ModelConfig(design=s2s.Design("learned", (16, 2, 2), 8), sensor=sensor)
>>> config = s2s.TrainConfig(model, epochs=1, steps_per_epoch=2, batch=2, crop=8, validation_views=1)
>>> with tempfile.TemporaryDirectory() as folder:
...     result = s2s.train(config, views, views, folder)
...     network = s2s.load_model(folder)
>>> result["steps"] == config.steps, network.config.name
(True, 'learned 16x2x2 K8, compact')
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from csph.codes.decode import decode_depth
    from csph.codes.design import Design
    from csph.codes.quantise import Quantised, encode_int16, quantised
    from csph.codes.temporal import temporal_code, truncated_fourier
    from csph.codes.tensor import CodingTensor, encode, encode_timestamps
    from csph.layer import CompressiveLayer, LayerOptions, make_coding

__all__ = [
    "CodingTensor",
    "CompressiveLayer",
    "Design",
    "LayerOptions",
    "Quantised",
    "decode_depth",
    "encode",
    "encode_int16",
    "encode_timestamps",
    "make_coding",
    "quantised",
    "temporal_code",
    "truncated_fourier",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "csph.codes.decode": ("decode_depth",),
        "csph.codes.design": ("Design",),
        "csph.codes.quantise": ("Quantised", "encode_int16", "quantised"),
        "csph.codes.temporal": ("temporal_code", "truncated_fourier"),
        "csph.codes.tensor": ("CodingTensor", "encode", "encode_timestamps"),
        "csph.layer": ("CompressiveLayer", "LayerOptions", "make_coding"),
    },
)
