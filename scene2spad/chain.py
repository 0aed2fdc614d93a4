"""The chain in functions: a scene is rendered, sensed and turned into depth, with NumPy arrays between."""

from __future__ import annotations

from dataclasses import fields
from numbers import Integral
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from scenes.errors import InputError, did_you_mean, require, require_kind
from scenes.progress import Progress

if TYPE_CHECKING:
    from csph.codes.tensor import CodingTensor
    from csph.networks.model import DepthModel
    from csph.weights.cards import Card
    from render.settings import RenderSettings
    from render.transient import Transient
    from scenes.model import Scene
    from scenes.placing import Placing
    from spad.measurements.histogram import Histogram
    from spad.sensor.budget import Optics
    from spad.sensor.model import Sensor

Law = Literal["auto", "poisson", "first-photon", "free-running"]
_RENDERING = RLock()  # what Dr.Jit records belongs to all threads, and would mix


def render(
    scene: Scene | str | Path,
    *,
    seed: int = 0,
    width: int | None = None,
    height: int | None = None,
    placing: Placing | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Transient:
    """Render the time-resolved radiance of a scene. Threads take turns.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, the name of a built-in one (see ``scene2spad scenes``), a mesh (.obj .ply .stl .glb) or Mitsuba's .xml.
    seed : int
        Seed of everything random. The same seed gives the same bytes.
    width, height : int, optional
        Image size in pixels of a scene that is loaded by name or from a file. One alone keeps the proportions.
    placing : Placing, optional
        How a scene that is loaded stands: its scale and camera, and of a mesh its upward axis and whether it is bare.
    progress : callable, optional
        Called with what is done and the share that is done, 0 to 1.
    **settings
        Fields of `RenderSettings`, above all ``error`` (target of the relative error, 0.02 if left out), ``budget``
        (signal and background photons per pixel: as fine as their shot noise can show), ``bounces`` (1: direct light
        alone), ``spp`` and ``filter``.

    Returns
    -------
    Transient
        Returns of every pixel: intervals of path length [m] and radiance [1/(m^2 sr)] per joule of the pulse, with
        depth [m], normals and albedo beside them. ``meta["relative_error"]`` holds the error that the render states,
        ``meta["target_met"]`` whether that is within the target.

    Raises
    ------
    InputError
        For an unknown name or setting, a bad file, or a value out of range.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=8, height=6, bounces=1)
    >>> transient.depth_m.shape
    (6, 8)
    """
    from render.engine import render as render_scene
    from scenes.model import Scene

    _check_progress(progress)
    chosen = _checked_settings(settings)
    if not isinstance(scene, Scene):
        scene = _loaded(str(scene), seed, width, height, placing)
    elif width is not None or height is not None or placing is not None:
        raise InputError("render: a Scene has its own camera; width, height and placing go with a name or a file")
    with _RENDERING:
        return render_scene(scene, chosen, seed=seed, progress=progress)


def _loaded(name: str, seed: int, width: int | None, height: int | None, placing: Placing | None) -> Scene:
    from scenes.library.catalog import load_scene
    from scenes.placing import AS_IT_IS, Placing

    if placing is not None:
        require_kind(placing, Placing, "render: placing")
    return load_scene(name, seed=seed, width=width, height=height, placing=placing or AS_IT_IS)


def _check_progress(progress: object) -> None:
    expected = "expected a function of what is done and the share that is done, 0 to 1"
    require(progress is None or callable(progress), f"render: progress {progress!r}, {expected}")


# What says how a scene stands, by the names of the command line and those of `Placing`, and the field of `Placing`.
PLACING = {"up": "up", "scale": "scale", "bare": "bare", "from_": "origin", "look_at": "target", "fov": "fov_deg"}
PLACING |= {field: field for field in PLACING.values()}


def _checked_settings(settings: dict[str, Any]) -> RenderSettings:
    """Return settings given by name; raise InputError for unknown ones and values of another kind or out of range."""
    from render.settings import RenderSettings

    known = [field.name for field in fields(RenderSettings)]
    for name, value in settings.items():
        if name in PLACING:
            field = PLACING[name]
            raise InputError(f"render: {name!r} is no setting, give placing=scene2spad.Placing({field}={value!r})")
        require(name in known, f"render: setting {name!r} is unknown{did_you_mean(name, known)}")
    return RenderSettings(**settings)


def sense(
    transient: Transient,
    *,
    signal: float = 50.0,
    background: float | None = None,
    sensor: Sensor | str | Path = "reference",
    optics: Optics | None = None,
    law: Law = "auto",
    seed: int = 0,
) -> Histogram:
    """Record one exposure of a transient with a single-photon sensor.

    Parameters
    ----------
    transient : Transient
        What `render` or `read_transient` gives.
    signal, background : float, optional
        Mean detections per pixel and exposure, over all pixels. The background includes dark counts; left out, it is
        50, or the sensor's dark counts if they are more. With `optics` both are computed instead.
    sensor : Sensor, str or Path
        A sensor, the name of a preset (as of ``scene2spad sense``), or a sensor file (.toml); not one of zones.
    optics : Optics, optional
        Laser energy, lens and filter: the photon budget is computed from them.
    law : str
        Detection law: auto, poisson, first-photon or free-running. ``meta["plan"]`` says why auto chose one.
    seed : int
        Seed of the photons, and of where hot and dead pixels are and which converter a pixel has.

    Returns
    -------
    Histogram
        ``counts`` (H, W, T) int32, with the sensor, and the true ``depth_m`` (H, W) beside them.

    Raises
    ------
    InputError
        For an unknown sensor or law, or a budget out of range.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=8, height=6, bounces=1)
    >>> s2s.sense(transient, signal=20, background=5).counts.shape
    (6, 8, 1024)
    """
    from render.transient import Transient
    from spad.detection.detect import sense as sense_exposure
    from spad.detection.rates import default_background
    from spad.sensor.budget import Optics
    from spad.sensor.files import pixel_sensor
    from spad.sensor.model import PhotonBudget

    require_kind(transient, Transient, "sense", " of `render` or `read_transient`")
    if optics is not None:
        require_kind(optics, Optics, "sense: optics")
    _check_seed(seed)
    chosen = pixel_sensor(sensor)
    background = default_background(transient, chosen, seed=seed) if background is None else background
    budget = PhotonBudget(signal, background) if optics is None else optics.budget(transient, chosen, seed=seed)
    return sense_exposure(transient, chosen, budget, seed=int(seed), model=law)


def _check_seed(seed: int) -> None:
    whole = isinstance(seed, Integral) and not isinstance(seed, bool) and seed >= 0
    require(whole, f"seed {seed!r}: expected a whole number, 0 or more")


def estimate_depth(histogram: Histogram, method: str | Path | CodingTensor | DepthModel = "log-matched") -> np.ndarray:
    """Estimate the radial depth of every pixel.

    Parameters
    ----------
    histogram : Histogram
        What `sense`, `read_histogram` or `read_mat` gives.
    method : str, Path, CodingTensor or DepthModel
        A classical estimator (argmax, matched, log-matched, lmf-published, correlation, coates), a code and its number
        (fourier-16) or a file of codes (.npy, .txt), the name or file of a trained network (`models` lists those that
        come with the package), a network that `load_model` gave, or a temporal coding tensor. Codes are decoded by
        correlation.

    Returns
    -------
    numpy.ndarray
        Depth in metres, (H, W) float32. NaN where a classical estimator finds no photon. A displaced laser is
        corrected for.

    Raises
    ------
    InputError
        For an unknown method, or a network of another sensor.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=8, height=8, bounces=1)
    >>> histogram = s2s.sense(transient, signal=200, background=20, seed=3)
    >>> depth_m = s2s.estimate_depth(histogram, "log-matched")
    >>> bool(abs(depth_m - histogram.depth_m).max() < 0.05)
    True
    >>> coded = s2s.estimate_depth(histogram, s2s.coding_tensor("fourier", 16))
    >>> coded.shape
    (8, 8)
    """
    from scene2spad.methods import decoded_by, depth_method
    from spad.measurements.histogram import Histogram

    require_kind(histogram, Histogram, "estimate_depth", " of `sense`, `read_histogram` or `read_mat`")
    if isinstance(method, str | Path):
        return depth_method(str(method), histogram.sensor)(histogram)
    from csph import CodingTensor

    if isinstance(method, CodingTensor):
        return decoded_by(method)(histogram)
    given = type(method).__name__
    known = "a name, a file, codes (`CodingTensor`) or a network"
    require(hasattr(method, "estimate"), f"depth method of type {given}: expected {known}")
    return method.estimate(histogram).depth_m


def coding_tensor(code: str, codes: int, sensor: Sensor | str | Path = "reference", *, seed: int = 0) -> CodingTensor:
    """Make the coding tensor of a pixel on its own: K codes of all time bins.

    Parameters
    ----------
    code : str
        fourier (truncated), gray, coarse, hadamard or random; fourier-published and gray-published have the published
        rows, cos and -sin at whole bins.
    codes : int
        The number K of codes, at least 2.
    sensor : Sensor, str or Path
        The sensor whose bins are coded, as `sense` takes it.
    seed : int
        Seed of random codes.

    Returns
    -------
    CodingTensor
        ``temporal`` (K, T): a detection in bin t adds column t to the pixel's K codes.

    Raises
    ------
    InputError
        For an unknown code, a number of codes that is not whole (8.0 is none), more codes than it has, or a seed that
        is no whole number from 0 on.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> tuple(s2s.coding_tensor("gray", 16).temporal.shape)
    (16, 1024)
    """
    from csph import CodingTensor, temporal_code
    from spad.sensor.files import pixel_sensor

    require_kind(code, str, "coding_tensor: code")
    chosen = pixel_sensor(sensor)
    _check_seed(seed)
    return CodingTensor(f"{code}-{codes}", temporal_code(code, codes, chosen.bins, chosen, seed))


def depth_errors(depth_m: np.ndarray, histogram: Histogram, *, unmixed: bool = False) -> dict[str, float | int]:
    """Compare a depth map with the truth that a histogram carries.

    Parameters
    ----------
    depth_m : numpy.ndarray
        Depth in metres, (H, W).
    histogram : Histogram
        The histogram that the depth was estimated from.
    unmixed : bool
        Leave out pixels that see surfaces more than 50 mm apart.

    Returns
    -------
    dict
        ``mae_mm``, ``rmse_mm``, ``median_mm`` (signed) and ``median_abs_mm`` over ``pixels`` pixels; the numbers of
        pixels left out are ``empty``, ``beyond_range`` and ``missing``. ``within_10mm`` is a share of ``pixels`` and
        ``missing`` together.

    Raises
    ------
    InputError
        For a depth map of another size.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=8, height=6, bounces=1))
    >>> s2s.depth_errors(histogram.depth_m, histogram)["mae_mm"]
    0.0
    """
    from spad.estimators.depth import histogram_errors
    from spad.measurements.histogram import Histogram

    require_kind(histogram, Histogram, "depth_errors", " as the truth")
    require(isinstance(unmixed, bool | np.bool_), f"depth_errors: unmixed {unmixed!r}, expected True or False")
    exclude = histogram.mixed if unmixed else None
    return histogram_errors(depth_m, histogram, exclude=exclude)


def models() -> list[Card]:
    """List the networks that come with the package.

    Returns
    -------
    list of Card
        Of each its ``name``, design, training set, photon levels, error, and what it must not be used for.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> "learned-256x4x4-128x-s0" in [card.name for card in s2s.models()]
    True
    """
    from csph.weights.cards import cards

    return cards()


def load_model(name: str | Path) -> DepthModel:
    """Load a trained depth network.

    Parameters
    ----------
    name : str or Path
        The name of a network that comes with the package (see `models`), a checkpoint (.safetensors), or the folder
        of a run of ``scene2spad train``.

    Returns
    -------
    DepthModel
        A torch module in evaluation mode. ``estimate(histogram)`` gives its depth and confidence.

    Raises
    ------
    InputError
        For an unknown name, or a file that is no checkpoint.

    Examples
    --------
    A network of 32 codes of 256 bins x 4 x 4 pixels finds a wall at 3 m:

    >>> import scene2spad as s2s
    >>> model = s2s.load_model("learned-256x4x4-128x-s0")
    >>> isinstance(model, s2s.DepthModel), model.config.block
    (True, (256, 4, 4))
    >>> histogram = s2s.sense(s2s.render("plane", width=8, height=8, bounces=1), signal=20, background=5)
    >>> estimate = model.estimate(histogram)
    >>> estimate.depth_m.shape, s2s.depth_errors(estimate.depth_m, histogram)["mae_mm"] < 200
    ((8, 8), True)
    """
    from csph.networks.checkpoint import load_model as load
    from csph.weights.cards import checkpoint_of

    return load(checkpoint_of(name))[0]
