"""The integrator plugin: dense output has the light and the paths of a render of the same file, in XML and by dict."""

import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from render.backend.llvm import start_mitsuba
from render.engine import render
from render.mitsuba_integrator import dense_path_histogram, register_integrator, scene_from_mitsuba
from render.settings import RenderSettings
from render.transient import Transient
from scenes.errors import InputError
from scenes.io.mitsuba.scene_file import load_mitsuba_xml

mi = start_mitsuba()
register_integrator()
XML = """<scene version="3.0.0">
  <integrator type="scene2spad"><integer name="temporal_bins" value="400"/><float name="bin_width_opl" value="0.03"/>
    <integer name="max_depth" value="2"/></integrator>
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="0.3,1,4" target="0,0.8,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>
  <shape type="rectangle"><transform name="to_world"><scale value="3"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.2 0.4 0.6"/></bsdf></bsdf></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.4"/><translate x="0.3" y="0.6" z="1"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></shape>
</scene>"""


def wall(distance_m: float = 3.0, **integrator: object) -> dict:
    place = mi.ScalarTransform4f().translate([0, 0, -distance_m]).scale(20)
    camera = mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, -1], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 9, "height": 9}
    return {
        "type": "scene",
        "integrator": {"type": "scene2spad", "max_depth": 2, **integrator},
        "sensor": {"type": "perspective", "fov": 20, "to_world": camera, "film": film},
        "wall": {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.5}},
    }


def test_a_wall_returns_albedo_times_intensity_over_pi_d2_in_its_bin():
    """Closed form at the centre pixel: radiance albedo x I / (pi d^2), I of the flood cone; path 2 d = 6 m."""
    data = np.array(mi.render(mi.load_dict(wall(temporal_bins=300, bin_width_opl=0.04))))
    assert data.shape == (9, 9, 300) and data.dtype == np.float32
    tangent = np.tan(np.radians(10))
    rim = np.arctan(np.hypot(tangent, tangent))  # the cone lights the corners
    intensity = 1 / (2 * np.pi * (1 - np.cos(rim)))
    centre = data[4, 4]
    assert centre.sum() == pytest.approx(0.5 * intensity / (np.pi * 9), rel=0.02)
    assert np.flatnonzero(centre).tolist() == [150] or set(np.flatnonzero(centre)) <= {149, 150, 151}
    assert centre[149:152].sum() == centre.sum()


def test_xml_gives_what_a_render_of_the_same_file_gives(tmp_path):
    """Two readers of one scene: Mitsuba's own, and ours of the file."""
    (tmp_path / "corner.xml").write_text(XML)
    data = np.array(mi.render(mi.load_file(str(tmp_path / "corner.xml"))))
    transient = render(load_mitsuba_xml(tmp_path / "corner.xml"), RenderSettings(bounces=1))
    expected = dense_path_histogram(transient, 400, 0.03)
    assert data.shape == (12, 16, 400)
    np.testing.assert_allclose(data.sum(axis=2), transient.total_radiance(), rtol=1e-3)
    assert np.abs(data - expected).sum() < 0.01 * expected.sum()


def test_start_and_range_leave_light_out_and_keep_the_rest():
    whole = np.array(mi.render(mi.load_dict(wall(temporal_bins=300, bin_width_opl=0.04))))
    late = np.array(mi.render(mi.load_dict(wall(temporal_bins=150, bin_width_opl=0.04, start_opl=6.0))))
    np.testing.assert_allclose(late, whole[..., 150:], rtol=1e-4, atol=1e-7 * whole.max())
    none = np.array(mi.render(mi.load_dict(wall(temporal_bins=10, bin_width_opl=0.04))))
    assert none.sum() == 0


@pytest.mark.parametrize("error", [0, 0.0, -1.0, 2.0])
def test_an_error_that_is_no_target_is_refused(error):
    with pytest.raises(RuntimeError, match=rf"error {float(error)} is outside 0.0001 to 1.0"):
        mi.load_dict({"type": "scene2spad", "error": error})
    assert mi.load_dict({"type": "scene2spad"}).settings.error is None


def test_returns_are_spread_by_overlap():
    """By hand, bins of 1 m: a point, a return over two bins, one over the end, one before the start."""
    zeros = np.zeros((1, 1), np.float32)
    layers = {
        "depth_m": zeros + 1,
        "albedo": zeros.astype(np.float16),
        "ambient": zeros,
        "error": zeros,
        "mixed": zeros.astype(bool),
    }
    transient = Transient(
        height=1,
        width=1,
        offsets=np.array([0, 4]),
        path_near_m=np.array([0.2, 1.5, 1.75, 3.5], np.float32),
        path_far_m=np.array([0.8, 1.5, 2.75, 4.5], np.float32),
        radiance=np.array([8, 1, 4, 2], np.float32),
        bounces=np.ones(4, np.uint8),
        normal=np.zeros((1, 1, 3), np.float16),
        meta={},
        **layers,
    )
    assert dense_path_histogram(transient, 3, 1.0, 1.0)[0, 0].tolist() == [2, 3, 1]


def test_returns_are_binned_part_by_part_in_any_number_of_bins(monkeypatch):
    """Many wide returns, and points between them, in parts that end anywhere within a pixel."""
    random = np.random.default_rng(3)
    near = np.sort(random.uniform(0, 9, (12, 20)), axis=1).ravel().astype(np.float32)
    layer = np.zeros((3, 4), np.float32)
    transient = Transient(
        height=3,
        width=4,
        offsets=np.arange(13) * 20,
        path_near_m=near,
        path_far_m=near + (random.uniform(0, 9, 240) * (random.uniform(0, 1, 240) < 0.7)).astype(np.float32),
        radiance=random.uniform(0, 1, 240).astype(np.float32),
        bounces=np.ones(240, np.uint8),
        depth_m=layer + 1,
        normal=np.zeros((3, 4, 3), np.float16),
        albedo=layer.astype(np.float16),
        ambient=layer,
        mixed=layer > 0,
        error=layer,
    )
    whole = dense_path_histogram(transient, 10000, 1e-3, 2.0)
    monkeypatch.setattr("render.mitsuba_integrator.ENTRIES", 20000)
    tracemalloc.start()
    parts = dense_path_histogram(transient, 10000, 1e-3, 2.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(parts, whole, rtol=1e-6)
    assert peak < 12 * 120000 + 30000 * 150


def test_a_material_whose_back_is_black_in_mitsuba_is_named(capfd):
    scene, level = mi.load_dict(wall()), mi.log_level()
    mi.set_log_level(mi.LogLevel.Warn)
    try:
        scene_from_mitsuba(scene, scene.sensors()[0])
    finally:
        mi.set_log_level(level)
    assert "shapes without twosided reflect from both sides here: wall" in "".join(capfd.readouterr())


@pytest.mark.parametrize(("near_m", "named"), [(0.1, False), (3.5, True)])
def test_what_clipping_planes_cut_in_mitsuba_is_named(capfd, near_m, named):
    described = wall()
    described["sensor"]["near_clip"] = near_m
    scene, level = mi.load_dict(described), mi.log_level()
    mi.set_log_level(mi.LogLevel.Warn)
    try:
        scene_from_mitsuba(scene, scene.sensors()[0])
    finally:
        mi.set_log_level(level)
    assert ("near_clip 3.5 or beyond far_clip 10000: wall" in "".join(capfd.readouterr())) == named


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wall": {"type": "sphere"}}, "is a Sphere, expected a mesh"),
        ({"wall": {"type": "cube", "bsdf": {"type": "plastic"}}}, "SmoothPlastic has no counterpart"),
        (
            {"wall": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}}},
            "SmoothDiffuse has no counterpart",
        ),
        ({"sensor": {"type": "orthographic"}}, "OrthographicCamera is not supported"),
    ],
)
def test_what_has_no_counterpart_is_refused_by_name(change, message):
    scene = mi.load_dict({**wall(), **change})
    with pytest.raises(InputError, match=message):
        scene.integrator().render(scene)
    with pytest.raises(RuntimeError) as wrapped:
        mi.render(scene)
    assert isinstance(wrapped.value.__cause__, InputError)


BAD = [{"temporal_bins": 0}, {"bin_width_opl": -1.0}, {"max_depth": 1}, {"max_depth": 65}, {"error": 2.0}]


@pytest.mark.parametrize("bad", BAD)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(RuntimeError) as wrapped:
        mi.load_dict({"type": "scene2spad", **bad})
    assert next(iter(bad)) in str(wrapped.value).splitlines()[-1], "the reason is the last line"


@pytest.mark.slow
def test_colours_become_luminance_and_the_variant_stays():
    code = f"""
import numpy as np
from render.backend.llvm import start_mitsuba
from render.mitsuba_integrator import register_integrator
mi, found = start_mitsuba(), []
for variant in ("llvm_ad_rgb", "llvm_ad_mono"):
    mi.set_variant(variant)
    register_integrator()
    found.append(np.array(mi.render(mi.load_string('''{XML}'''))))
    assert mi.variant() == variant
np.testing.assert_allclose(*found, rtol=3e-4, atol=1e-6 * found[1].max())  # Rec. 709 weights to 4 and 6 digits
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (5, "name 5, expected text"),
        ("", "name '', expected text"),
        ("path", r"'path' is a plugin of Mitsuba already \(Integrator\), choose another name"),
        ("diffuse", r"'diffuse' is a plugin of Mitsuba already \(BSDF\), choose another name"),
    ],
)
def test_names_of_other_plugins_are_refused(name, message):
    with pytest.raises(InputError, match=f"^register_integrator: {message}$"):
        register_integrator(name)
    for _ in range(2):
        register_integrator("mine")
