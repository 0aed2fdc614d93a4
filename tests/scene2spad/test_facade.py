"""The public names: they exist, and they start nothing."""

import inspect
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from processes import run_process

import scene2spad as s2s
from scene2spad.cli import main
from spad.estimators.depth import histogram_depth_m

WALL = s2s.transient_from_rgbd(np.full((4, 4), 2.0), np.ones((4, 4)), np.ones((4, 4)))
WITHOUT_ERRORS = ("models",)
HEAVY = ("mitsuba", "drjit", "torch", "matplotlib", "scipy", "h5py", "OpenEXR", "trimesh")


def test_importing_starts_nothing():
    asked = f"import sys, scene2spad; print([n for n in {HEAVY} if n in sys.modules])"
    done = run_process([sys.executable, "-c", asked])
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_every_public_name_is_there_and_listed_once():
    assert len(set(s2s.__all__)) == len(s2s.__all__)
    assert set(s2s.__all__) <= set(dir(s2s))
    for name in s2s.__all__:
        words = inspect.getdoc(getattr(s2s, name)) or ""
        assert words, name
        if inspect.isfunction(getattr(s2s, name)) and name not in WITHOUT_ERRORS:
            assert "Raises" in words or "InputError" in words, f"{name} names no error"
    assert s2s.__version__.count(".") == 2


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        s2s.rendr  # noqa: B018


@pytest.fixture(scope="module")
def histogram():
    return s2s.sense(s2s.render("plane", width=16, height=16, bounces=1), signal=100, background=20, seed=2)


def test_depth_is_that_of_the_parts(histogram):
    assert np.array_equal(s2s.estimate_depth(histogram, "matched"), histogram_depth_m(histogram, "matched"))
    model = s2s.load_model("learned-256x4x4-128x-s0")
    by_name = s2s.estimate_depth(histogram, "learned-256x4x4-128x-s0")
    assert np.array_equal(by_name, s2s.estimate_depth(histogram, model))
    assert s2s.depth_errors(by_name, histogram)["mae_mm"] < 100


def test_an_own_mesh_is_placed_as_on_the_command_line(tmp_path):
    """A ball of radius 30 in a file of millimetres, bare: its nearest point is the camera's distance less 30 mm."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=30)
    ball.export(tmp_path / "ball.stl")
    placing = s2s.Placing(scale=1e-3, origin=(0, 0.03, 1), target=(0, 0.03, 0), fov_deg=5, bare=True)
    transient = s2s.render(tmp_path / "ball.stl", width=9, height=9, bounces=1, placing=placing)
    assert np.nanmin(transient.depth_m) == pytest.approx(0.97, abs=1e-3)
    assert np.isnan(transient.depth_m[0, 0])  # neither a floor nor a wall
    out = tmp_path / "ball.exr"
    words = (
        "--scale 0.001 --from 0 0.03 1 --look-at 0 0.03 0 --fov 5 --bare --width 9 --height 9 --bounces 1 --no-figure"
    )
    assert main(["render", str(tmp_path / "ball.stl"), *words.split(), "--out", str(out)]) == 0
    assert s2s.read_transient(out).sha256() == transient.sha256()


def test_optics_place_hot_pixels_by_the_seed_of_the_photons(monkeypatch):
    seeds = []

    def budget(self, transient, sensor, *, seed=0, dark_map_hz=None):
        seeds.append(seed)
        return s2s.PhotonBudget(10, 10)

    monkeypatch.setattr(s2s.Optics, "budget", budget)
    transient = s2s.render("plane", width=4, height=4, bounces=1)
    s2s.sense(transient, optics=s2s.Optics(1e-9, 10e-3, 2.0, 20e-6), seed=5)
    assert seeds == [5]


def test_optics_compute_the_photon_budget():
    transient = s2s.render("plane", width=8, height=6, bounces=1)
    lens = {"focal_length_m": 0.01, "f_number": 2.0, "pixel_pitch_m": 20e-6}
    twice = [s2s.sense(transient, optics=s2s.Optics(pulse_energy_j=energy, **lens)) for energy in (1e-9, 2e-9)]
    ratio = twice[1].expected_signal.mean() / twice[0].expected_signal.mean()
    assert ratio == pytest.approx(2, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda h: s2s.render("plane", eror=0.1), "setting 'eror' is unknown; did you mean 'error'"),
        (lambda h: s2s.render(s2s.load_scene("plane"), width=8), "own camera"),
        (lambda h: s2s.render("plane", budget=3), "budget 3, expected two numbers: signal and background photons"),
        (lambda h: s2s.render("plane", budget=(3,)), r"budget \(3,\), expected two numbers"),
        (lambda h: s2s.render("plane", budget=("a", 3)), r"budget \('a', 3\), expected two numbers"),
        (lambda h: s2s.render("plane", error="0.1"), "render: error '0.1', expected a number"),
        (lambda h: s2s.render("plane", ambient="on"), "render: ambient 'on', expected True, False or None"),
        (lambda h: s2s.render("no-such-scene", filter="on"), "render: filter 'on', expected True or False"),
        (lambda h: s2s.RenderSettings(filter="x"), "render: filter 'x', expected True or False"),
        (lambda h: s2s.RenderSettings(adaptive="no"), "render: adaptive 'no', expected True or False"),
        (lambda h: s2s.RenderSettings(ambient="x"), "render: ambient 'x', expected True, False or None"),
        (
            lambda h: s2s.RenderSettings(refraction=np.array(["a", "b"])),
            "refraction array.*, expected straight or bent",
        ),
        (lambda h: s2s.RenderSettings(budget=3), "budget 3, expected two numbers: signal and background photons"),
        (lambda h: s2s.RenderSettings(budget="ab"), "budget 'ab', expected two numbers"),
        (lambda h: s2s.RenderSettings(budget=(10, "a")), r"budget \(10, 'a'\), expected two numbers"),
        (lambda h: s2s.RenderSettings(error="0.1"), "render: error '0.1', expected a number"),
        (lambda h: s2s.RenderSettings(direct_tolerance_m="a"), "direct_tolerance_m 'a', expected a number"),
        (lambda h: s2s.CodingTensor(5, np.eye(2)), "coding tensor: name: expected a str, not int"),
        (lambda h: s2s.CodingTensor("a", np.eye(2), steps=(0, -1)), "a: steps of 0 and -1, expected both above 0"),
        (lambda h: s2s.CodingTensor("a", np.eye(2), steps=3), "a: steps 3, expected a pair of numbers above 0"),
        (
            lambda h: s2s.CompressiveLayer(s2s.coding_tensor("gray", 16), options={}),
            "expected a LayerOptions, not dict",
        ),
        (lambda h: s2s.encode(np.array([1, np.nan]), s2s.CodingTensor("a", np.eye(2))), "the counts hold NaN or"),
        (lambda h: s2s.Program(None, (), (), {}, ()), "program: name: expected a str, not NoneType"),
        (lambda h: s2s.Program("a", (5,), (), {}, ()), r"a: instructions\[0\]: expected an Instruction, not int"),
        (lambda h: s2s.CompressiveLayer(s2s.Design()), "a CodingTensor .*`CompressiveLayer.of` .* not Design"),
        (lambda h: s2s.render("galery"), "gallery"),
        (lambda h: s2s.render("ball.stl", bare=True), r"'bare' is no setting, give placing=.*Placing\(bare=True\)"),
        (lambda h: s2s.render("ball.stl", fov=30), r"'fov' is no setting, give placing=.*Placing\(fov_deg=30\)"),
        (lambda h: s2s.render("plane", placing={"scale": 2}), "render: placing: expected a Placing, not dict"),
        (lambda h: s2s.render(s2s.load_scene("plane"), placing=s2s.Placing(scale=2)), "placing go with a name"),
        (lambda h: s2s.render("plane", placing=s2s.Placing(bare=True)), "`bare` are for mesh files"),
        (lambda h: s2s.render("plane", width=2, height=2, bounces=1, progress=3), "progress 3, expected a function"),
        (lambda h: WALL.delayed("x"), "time offset 'x', expected a number"),
        (lambda h: WALL.delayed(float("nan")), "time offset nan m is outside"),
        (lambda h: s2s.read_transient(3), "read_transient: expected a path, not int"),
        (lambda h: s2s.write_transient(WALL, None), "write_transient: expected a path, not NoneType"),
        (lambda h: s2s.read_histogram(3), "read_histogram: expected a path, not int"),
        (lambda h: s2s.write_histogram(h, 3), "write_histogram: expected a path, not int"),
        (lambda h: s2s.read_mat(3), "read_mat: expected a path, not int"),
        (lambda h: s2s.write_mat(h, 3), "write_mat: expected a path, not int"),
        (lambda h: s2s.write_mat(WALL, "x.mat"), "write_mat: expected a Histogram, not Transient"),
        (lambda h: s2s.estimate_depth(h, "log-machted"), "log-matched"),
        (lambda h: s2s.load_model("nosuch"), "nosuch"),
        (lambda h: s2s.coding_tensor("furier", 8), "furier"),
        (lambda h: s2s.coding_tensor(["fourier"], 8), "coding_tensor: code: expected a str, not list"),
        (lambda h: s2s.coding_tensor("random", 8, seed=None), "seed None: expected a whole number, 0 or more"),
        (lambda h: s2s.depth_errors(h.depth_m, h, unmixed="no"), "unmixed 'no', expected True or False"),
        (lambda h: s2s.sense(h), "sense: expected a Transient of `render` or `read_transient`, not Histogram"),
        (lambda h: s2s.sense("x.exr"), "expected a Transient .* not str"),
        (lambda h: s2s.sense(WALL, signal="10"), "signal '10', expected a number"),
        (lambda h: s2s.sense(WALL, sensor=3), "sensor: expected a Sensor or its name, not int"),
        (lambda h: s2s.sense(WALL, sensor="swisspad3"), "did you mean 'swissspad3'"),
        (lambda h: s2s.sense(WALL, sensor="tmf8820"), "tmf8820 has zones, expected one of pixels"),
        (lambda h: s2s.sense(WALL, optics=3), "sense: optics: expected an Optics, not int"),
        (lambda h: s2s.estimate_depth(WALL), "estimate_depth: expected a Histogram .* not Transient"),
        (lambda h: s2s.estimate_depth(h.counts, s2s.coding_tensor("gray", 16)), "expected a Histogram .* not ndarray"),
        (lambda h: s2s.Histogram.from_counts(h.counts, None), "sensor: expected a Sensor or its name, not NoneType"),
        (lambda h: s2s.depth_errors(h.depth_m + 1j, h), "values are complex64, expected real numbers"),
        (lambda h: s2s.depth_errors(h.depth_m, WALL), "expected a Histogram as the truth, not Transient"),
        (lambda h: s2s.write_histogram(WALL, Path("x.h5")), "expected a Histogram, not Transient"),
        (lambda h: s2s.write_transient(h, Path("x.exr")), "expected a Transient, not Histogram"),
    ],
)
def test_mistakes_are_one_line(histogram, call, message):
    with pytest.raises(s2s.InputError, match=message) as caught:
        call(histogram)
    assert "\n" not in str(caught.value)


def test_sensors_are_taken_by_name_wherever_one_is_asked_for(histogram):
    """Take those that come as files, too, as on the command line; and files."""
    sensed = s2s.sense(WALL, sensor="swissspad3")
    assert sensed.sensor.name == "swissspad3"
    again = s2s.Histogram.from_counts(sensed.counts, "swissspad3")
    assert again.sensor == sensed.sensor and s2s.coding_tensor("gray", 8, "pf32").temporal.shape[0] == 8
    assert s2s.Histogram.from_counts(histogram.counts, histogram.sensor).sensor == histogram.sensor


def test_scenes_render_from_several_threads_as_from_one():
    """Dr.Jit refused to replay in one thread what another was recording."""

    def rendered(seed):
        return s2s.render("plane", width=8, height=6, bounces=1, seed=seed).sha256()

    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(rendered, range(8)))
    assert together == [rendered(seed) for seed in range(8)]
