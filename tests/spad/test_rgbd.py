"""RGB-D images to counts in both conventions, the .mat layout both ways, and the radiometric budget."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from test_flux import transient_of

from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from scenes.optics.blackbody import sunlight_w_per_m2_nm
from spad.detection.detect import sense
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.formats.mat import read_mat, write_mat
from spad.formats.rgbd import cosine_of_incidence, published_from_rgbd, published_taps, transient_from_rgbd
from spad.sensor.budget import Optics
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.tdc import Tdc
from spad.sensor_names import sensor_by_name

TRAIN = sensor_by_name("iccv2023-train")
LIGHT = 3e8


def scene(height: int = 6, width: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(1, 9, (height, width)), rng.uniform(0.1, 1, (height, width)), rng.uniform(0, 1, (height, width))


# Conventions


def test_ours_is_the_definition() -> None:
    """Centroid at 2 d / c, albedo / d^2 without a field of view, means over the image."""
    depth, albedo, ambient = scene()
    transient = transient_from_rgbd(depth, albedo, ambient)
    rates = rates_for(transient, Sensor(), PhotonBudget(30, 60))
    counts = expected_counts(transient, Sensor(), rates, slice(0, depth.size))[0].numpy().reshape(*depth.shape, 1024)
    falloff = albedo / depth**2
    assert np.allclose(rates.background, 60 * ambient / ambient.mean(), rtol=1e-6)
    pulse = counts - (rates.background / 1024)[..., None]
    assert np.allclose(pulse.sum(axis=-1), 30 * falloff / falloff.mean(), rtol=1e-6)
    centroid = pulse @ (np.arange(1024) + 0.5) / pulse.sum(axis=-1)
    assert np.abs(centroid * Sensor().bin_depth_m - depth).max() < 2e-5


def test_published_is_the_definition() -> None:
    depth, albedo, ambient = scene()
    expected = published_from_rgbd(depth, albedo, ambient, Sensor(), PhotonBudget(30, 60))
    taps = published_taps(Sensor())
    falloff = albedo / depth**2
    for row, column in np.ndindex(depth.shape):
        beta = max(1, round(2 * depth[row, column] / (LIGHT * Sensor().bin_width_s)) % 1024)
        rate = np.full(1024, 60 * ambient[row, column] / ambient.mean() / 1024)
        for tap, fraction in enumerate(taps):
            rate[(beta - 1 + tap - 10) % 1024] += 30 * falloff[row, column] / falloff.mean() * fraction
        assert np.allclose(expected.rates[row, column], rate, rtol=1e-12)
        assert expected.depth_m[row, column] == pytest.approx((beta - 1) * LIGHT * Sensor().bin_width_s / 2)
    assert expected.rates.sum(axis=-1).mean() == pytest.approx(90)


def test_published_pulses() -> None:
    """Facts of the published code: 22 samples, the largest the 11th, centroid 0.441 bins before it."""
    taps = published_taps(Sensor(pulse=Pulse(135e-12)))
    assert len(taps) == 22 and taps.argmax() == 10
    assert taps @ np.arange(1, 23) - 11 == pytest.approx(-0.441, abs=1e-3)
    assert len(published_taps(Sensor(pulse=Pulse(50e-12)))) == 8
    assert len(published_taps(Sensor(pulse=Pulse(500e-12)))) == 81
    assert published_taps(TRAIN).argmax() == 6
    with pytest.raises(InputError, match="Gaussian"):
        published_taps(Sensor(pulse=Pulse(1e-10, 1e-10)))


@pytest.mark.parametrize("pulse", [Sensor().pulse, TRAIN.pulse], ids=["Gaussian", "measured"])
def test_the_published_convention_knows_no_jitter_and_no_converters(pulse) -> None:
    """Refuse jitter of detector and clock beside either kind of pulse: its taps would be too narrow."""
    sensor = replace(TRAIN, pulse=pulse, dark_count_rate_hz=0.0)
    even = Tdc(sensor.period_s / 4, codes=256)
    for jittery in (replace(sensor, jitter=Pulse(5e-11)), replace(sensor, tdc=replace(even, jitter_s=5e-11))):
        with pytest.raises(InputError, match="no jitter of detector or clock, sensor iccv2023-train has one"):
            published_taps(jittery)
    with pytest.raises(InputError, match="published convention: the converters"):
        published_from_rgbd(*scene(), replace(sensor, tdc=even), PhotonBudget(1, 1))


@pytest.mark.parametrize(("background", "fraction"), [(2, 0.94), (10, 0.76), (50, 0.39)])
def test_published_dark_share(background: float, fraction: float) -> None:
    """Compare dark counts, as part of the mean background, with what pixels without ambient light have."""
    flat = np.ones((64, 64))
    ambient = np.tile([0.0, 2.0], (64, 32))
    found = published_from_rgbd(flat, flat, ambient, TRAIN, PhotonBudget(10, background)).background
    assert found[:, ::2].mean() / background == pytest.approx(fraction, abs=0.005)
    assert found.mean() == pytest.approx(background)


def test_blocks_give_an_edge_two_returns() -> None:
    depth = np.full((8, 8), 2.0)
    depth[:, 2:] = 3.0
    depth[0, 7] = np.nan
    transient = transient_from_rgbd(depth, np.ones_like(depth), np.ones_like(depth), block=4)
    assert transient.mixed.tolist() == [[True, True], [True, False]] and transient.returns == 63
    assert sorted(set(transient.path_near_m.tolist())) == [4.0, 6.0]
    assert transient.depth_m.tolist() == [[3.0, 3.0], [3.0, 3.0]]
    with pytest.raises(InputError, match="whole number of blocks"):
        transient_from_rgbd(depth, depth, depth, block=3)


@pytest.mark.parametrize("block", [2, 3, 4])
def test_labels_of_blocks_are_those_at_the_pixel_centre(block: int) -> None:
    """A wall that slants by 2 mm a sample, sampled at the samples' centres, and its linear albedo."""
    side = 6 * block
    column = np.arange(side) + 0.5
    depth, albedo = np.tile(2 + 2e-3 * column, (side, 1)), np.tile(0.2 + 2e-2 * column, (side, 1))
    transient = transient_from_rgbd(depth, albedo, albedo, block=block)
    centre = (np.arange(6) + 0.5) * block
    assert np.allclose(transient.depth_m, 2 + 2e-3 * centre, atol=1e-6)
    assert np.allclose(transient.albedo, 0.2 + 2e-2 * centre, atol=1e-3)
    # no depth in between where the four samples at the centre lie on two surfaces: 1 % is the bound
    for step, label in ((0.009, 1.0045), (0.02, 1.02)):
        edge = np.tile([1.0, 1.0 + step], (2, 1))
        assert transient_from_rgbd(edge, edge, edge, block=2).depth_m == pytest.approx(label)
    assert transient_from_rgbd(np.array([[1, np.nan], [1, 1]]), *np.ones((2, 2, 2)), block=2).depth_m == 1


def test_cosine_of_a_tilted_plane() -> None:
    """z = 2 + x tan 40 deg: the angle between its normal and each pixel's ray."""
    width, fov, slope = 60, 50.0, math.tan(math.radians(40))
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(40) + 0.5 - 20)
    rays = np.stack([x, y, np.full_like(x, focal)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    depth = 2 / (rays[..., 2] - rays[..., 0] * slope)
    expected = np.abs(rays @ np.array([-slope, 0, 1]) / math.hypot(slope, 1))
    assert np.abs(cosine_of_incidence(depth, fov) - expected).max() < 1e-9
    transient = transient_from_rgbd(depth, np.ones_like(depth), depth, fov_deg=fov)
    assert np.allclose(transient.total_radiance(), expected / (np.pi * depth**2), rtol=1e-5)


def test_bad_rgbd_is_refused_in_one_line() -> None:
    depth, albedo, ambient = scene()
    for bad, words in (
        ((depth[:3], albedo, ambient), "shapes"),
        ((depth, -albedo, ambient), "0 or more"),
    ):
        with pytest.raises(InputError, match=words):
            transient_from_rgbd(*bad)
        with pytest.raises(InputError, match=words if words == "shapes" else "albedo"):
            published_from_rgbd(*bad, Sensor(), PhotonBudget(1, 1))
    with pytest.raises(InputError, match="every pixel"):
        published_from_rgbd(depth * math.nan, albedo, ambient, Sensor(), PhotonBudget(1, 1))


# NYUv2 frames


def shrunk(image: np.ndarray, size: int) -> np.ndarray:
    """Antialiased bilinear reduction as in MATLAB's imresize: triangles of twice the step, edges mirrored."""
    step = image.shape[0] / size
    weights = np.zeros((size, image.shape[0]))
    for i in range(size):
        centre = (i + 0.5) * step - 0.5
        for j in range(math.floor(centre - step), math.ceil(centre + step) + 1):
            mirrored = j if 0 <= j < image.shape[0] else (-1 - j if j < 0 else 2 * image.shape[0] - 1 - j)
            weights[i, mirrored] += max(0.0, 1 - abs(j - centre) / step)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights @ image @ weights.T


@pytest.mark.parametrize(("frame", "level"), [("spad_0001_p1", (2, 50)), ("spad_0071_p1", (10, 2))])
def test_nyuv2_frames_and_their_bins(frame: str, level: tuple, shared_data: Path) -> None:
    path = shared_data / "nyuv2" / f"{frame}.mat"
    histogram, raw = read_mat(path), scipy.io.loadmat(path)
    assert histogram.counts.shape == (64, 64, 1024) and histogram.sensor.bin_width_s == 80e-12
    assert (histogram.budget.signal, histogram.budget.background) == pytest.approx(level)
    assert histogram.counts.sum() == raw["spad"].sum()
    assert histogram.counts.sum() / 4096 == pytest.approx(sum(level), abs=5 * math.sqrt(sum(level) / 4096))
    # the high-resolution bins, unrounded, are depth: reduced as MATLAB does, they give every published bin again
    depth = shrunk(raw["bin_hr"], 64) * LIGHT * 80e-12 / 2
    flat = np.ones((64, 64))
    expected = published_from_rgbd(depth, flat, flat, TRAIN, PhotonBudget(50, 5))
    assert (np.rint(expected.depth_m / (LIGHT * 80e-12 / 2)) + 1 == raw["bin"]).all()
    assert (expected.rates.argmax(axis=-1) == raw["rates"].argmax(axis=-1)).all()
    # pixels are column-major: their photons lie where the bins are
    near = np.abs(np.arange(1024) + 1 - raw["bin"][..., None].astype(int) - 0.77) < 6
    fraction = histogram.counts[near].sum() / histogram.counts.sum()
    assert fraction > 0.9 * (level[0] + sum(level) * 12 / 1024) / sum(level) * 0.9


# The newer layout


def made(height: int = 5, width: int = 7):
    rng = np.random.default_rng(4)
    depth = rng.uniform(0.5, 14, (height, width))
    depth[2, 3] = np.nan
    image = rng.uniform(0.2, 1, (height, width))
    transient = transient_from_rgbd(depth, image, image)
    return sense(transient, Sensor(), PhotonBudget(200, 20), seed=1)


def test_exported_frame_for_an_independent_reader(tmp_path: Path) -> None:
    histogram = made()
    pulse = write_mat(histogram, tmp_path / "spad_Art_200_20.mat")
    frame = scipy.io.loadmat(tmp_path / "spad_Art_200_20.mat")
    shape = (5, 7)
    spad = np.asarray(frame["spad"].todense())
    assert spad.shape == (35, 1024)
    for row, column in np.ndindex(shape):
        assert (spad[column * 5 + row] == histogram.counts[row, column]).all()
    depth = histogram.depth_m.astype(float)
    known = np.isfinite(depth)
    width_s = frame["bin_size"].item()
    assert width_s == Sensor().bin_width_s
    # 1-based index of the bin that holds the arrival, and the pulse's peak with it
    assert (frame["bin"][known] == np.floor(2 * depth[known] / (C * width_s)) + 1).all()
    assert (frame["bin"] == frame["range_bins"]).all() and frame["bin"].dtype == np.uint16 and frame["bin"][2, 3] == 1
    assert (np.round(frame["bin_hr"][known] + 1e-9) == frame["bin"][known]).all()
    rates = frame["rates"]
    assert rates.shape == (5, 7, 1024) and rates.min() == 0 and rates[known].max(axis=-1).min() > 0.999999
    peak = rates[known].argmax(axis=-1) + 1
    assert (np.abs(peak - frame["bin"][known].astype(int)) <= 1).all() and (peak == frame["bin"][known]).mean() > 0.8
    params = frame["rates_norm_params"][0, 0]
    undone = rates / params["rates_scaling"][..., None] + params["rates_offset"][..., None]
    assert np.allclose(undone.sum(axis=-1)[known], histogram.expected_signal[known], rtol=1e-4)
    # as their loader makes its label
    label = rates / (rates.sum(axis=-1, keepdims=True) + 1e-8)
    centroid = (label @ (np.arange(1024) + 0.5))[known] * C * width_s / 2
    assert np.abs(centroid - depth[known]).max() < 1e-3 and label[2, 3].sum() == 0
    for name in ("argmax", "lmf", "zncc"):
        estimate = frame[f"est_range_bins_{name}"].astype(int)
        assert estimate.shape == shape and np.median(np.abs(estimate - frame["bin"].astype(int))[known]) <= 1
    assert frame["intensity"].shape == frame["intensity_hr"].shape == frame["dist"].shape == shape
    assert frame["SBR"].item() == 10 and frame["photons"].item() == frame["mean_signal_photons"].item() == 200
    assert frame["mean_background_photons"].item() == 20
    psf = scipy.io.loadmat(pulse)
    assert re.fullmatch(r"PSF_used_for_simulation_nr-5_nc-7\.mat", pulse.name)
    assert psf["PSF_img"].shape == (5, 7, psf["psf"].size) and psf["psf"].sum() == pytest.approx(1, abs=1e-6)
    assert psf["pulse_len"].item() == psf["psf"].size


def test_exported_frame_reads_back(tmp_path: Path) -> None:
    histogram = made()
    write_mat(histogram, tmp_path / "f.mat")
    again = read_mat(tmp_path / "f.mat")
    assert (again.counts == histogram.counts).all() and again.budget == histogram.budget
    assert np.array_equal(again.depth_m, histogram.depth_m, equal_nan=True)
    assert (again.sensor.bins, again.sensor.bin_width_s) == (1024, Sensor().bin_width_s)
    assert np.allclose(again.albedo, histogram.albedo)


def test_foreign_mat_files_are_refused_in_one_line(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "x.mat", {"a": 1})
    (tmp_path / "y.mat").write_bytes(b"MATLAB 5.0" * 40)
    for name, words in (("x.mat", "missing"), ("y.mat", "readable"), ("z.mat", "not found")):
        with pytest.raises(InputError, match=words) as refused:
            read_mat(tmp_path / name)
        assert "\n" not in str(refused.value)
    gated = replace(made(), sensor=Sensor(period_s=2 * Sensor().period_s))
    with pytest.raises(InputError, match="cover the period"):
        write_mat(gated, tmp_path / "g.mat")
    timed = replace(made(), sensor=sensor_by_name("reference-tdc"))
    with pytest.raises(InputError, match=r"g\.mat: the layout: the converters \(tdc\) of reference-tdc"):
        write_mat(timed, tmp_path / "g.mat")
    assert not (tmp_path / "g.mat").exists()


# Radiometric budget: the worked example of docs/radiometric.md

EXAMPLE = Optics(
    pulse_energy_j=1e-9,
    focal_length_m=10e-3,
    f_number=2.0,
    pixel_pitch_m=20e-6,
    transmission=0.7,
    filter_nm=10.0,
    wavelength_m=850e-9,
)
SENSOR = Sensor(name="example", pde=0.2, dark_count_rate_hz=125.0)
CONE_SR = math.radians(20) ** 2
DOCUMENT = Path(__file__).parents[2] / "docs" / "radiometric.md"


def target():
    """10 % target at 5 m that faces the camera, lit uniformly in the cone, in sunlight of 100 klux from the front."""
    radiance = 0.1 / (math.pi * 5.0**2) / CONE_SR
    sun = 0.1 / math.pi * sunlight_w_per_m2_nm(1e5, 850e-9)
    return transient_of([(10.0, 10.0, radiance)], ambient=[sun])


def test_worked_example_number_by_number() -> None:
    """Every number of the document, derived here once more from constants alone."""
    planck, light = 6.62607015e-34, 299_792_458.0
    photon = planck * light / 850e-9
    aperture = math.pi * (5e-3 / 2) ** 2
    pixel = (20e-6 / 10e-3) ** 2
    received = 1e-9 * 0.1 / (math.pi * 25) / CONE_SR * aperture * pixel
    per_pulse = received * 0.7 * 0.2 / photon
    cycles = (1 / 30) / 100e-9
    wavelength = np.linspace(360e-9, 830e-9, 20001)
    body = (
        2 * math.pi * planck * light**2 / wavelength**5 / np.expm1(planck * light / (wavelength * 1.380649e-23 * 5778))
    )
    nm = wavelength * 1e9
    eye = 0.821 * np.exp(-0.5 * ((nm - 568.8) / np.where(nm < 568.8, 46.9, 40.5)) ** 2)
    eye += 0.286 * np.exp(-0.5 * ((nm - 530.9) / np.where(nm < 530.9, 16.3, 31.1)) ** 2)
    lumens = 683 * np.trapezoid(eye * body, wavelength)
    at_850 = 2 * math.pi * planck * light**2 / 850e-9**5 / np.expm1(planck * light / (850e-9 * 1.380649e-23 * 5778))
    sun = 1e5 * at_850 * 1e-9 / lumens
    background = sun * 0.1 / math.pi * 10 * aperture * pixel * 0.7 * 0.2 / photon / 30
    budget = EXAMPLE.budget(target(), SENSOR)
    assert budget.signal == pytest.approx(per_pulse * cycles, rel=1e-5)
    assert budget.background == pytest.approx(background + 125 / 30, rel=1e-3)
    common = {
        "photon energy": photon,
        "aperture area": aperture,
        "pixel solid angle": pixel,
        "cone": CONE_SR,
        "energy per pulse at the pixel": received,
        "signal detections per pulse": per_pulse,
        "cycles": cycles,
        "signal detections per exposure": per_pulse * cycles,
        "solar spectral irradiance": sun,
        "ambient radiance": sun * 0.1 / math.pi,
        "ambient detections per exposure": background,
        "dark counts per exposure": 125 / 30,
        "background detections per exposure": background + 125 / 30,
        "detections per cycle": (per_pulse * cycles + background + 125 / 30) / cycles,
    }
    c4, pupil = 10 ** (0.002 * (850 - 700)), math.pi / 4 * 0.007**2 / (0.1**2 * CONE_SR)
    common |= {
        "class-1 mean power": 3.9e-4 * c4,
        "share through the pupil": pupil,
        "mean power through the pupil": 1e-9 / 100e-9 * pupil,
        "class-1 energy within 5 us": 7.7e-8 * c4,
        "energy through the pupil within 5 us": 5e-6 / 100e-9 * 1e-9 * pupil,
    }
    assert common["mean power through the pupil"] / common["class-1 mean power"] == pytest.approx(0.41, abs=0.005)
    # the standard's three branches meet: at 10 s to its two digits, at 5 us to its rounding
    middle_w, middle_j = 7e-4 * 10**0.75 / 10, 7e-4 * 5e-6**0.75
    assert middle_w == pytest.approx(3.9e-4, rel=0.02) and middle_j == pytest.approx(7.7e-8, rel=0.05)
    text = DOCUMENT.read_text(encoding="utf-8")
    for name, value in common.items():
        row = re.search(rf"^\| {re.escape(name)} \|.*\| ([-+.\de]+) [^|]*\|$", text, re.MULTILINE)
        assert row, f"docs/radiometric.md has no row {name!r}"
        assert float(row[1]) == pytest.approx(value, rel=6e-3), name


def test_radiometric_and_mean_budget_meet() -> None:
    transient = transient_of([(2.0, 2.1, 3e-4)], [(4.0, 4.0, 2e-4), (9.0, 9.5, 1e-4)], [], ambient=[0.01, 0.03, 0.0])
    budget = EXAMPLE.budget(transient, SENSOR)
    rates = rates_for(transient, SENSOR, budget)
    assert rates.signal_scale == pytest.approx(EXAMPLE.signal_scale(SENSOR), rel=1e-6)
    ambient = transient.ambient * EXAMPLE.filter_nm * EXAMPLE.detections_per_radiance(SENSOR) / 30
    assert np.allclose(rates.background, ambient + 125 / 30, rtol=1e-6)
    twice = replace(EXAMPLE, pulse_energy_j=2e-9).budget(transient, SENSOR)
    assert twice.signal == pytest.approx(2 * budget.signal) and twice.background == pytest.approx(budget.background)


@pytest.mark.parametrize(
    "bad",
    [{"f_number": 0.0}, {"transmission": 1.5}, {"pulse_energy_j": -1.0}, {"wavelength_m": 850}, {"wavelength_m": 1e-8}],
)
def test_bad_optics_are_refused(bad: dict) -> None:
    with pytest.raises(InputError, match="optics"):
        replace(EXAMPLE, **bad)


def test_a_laser_that_is_off_leaves_the_background() -> None:
    transient = transient_of([(2.0, 2.1, 3e-4)], [(4.0, 4.0, 2e-4)], ambient=[0.02, 0.03])
    dark = replace(EXAMPLE, pulse_energy_j=0.0).budget(transient, SENSOR)
    assert dark == PhotonBudget(0.0, EXAMPLE.budget(transient, SENSOR).background)
    with pytest.raises(InputError, match="pulse_energy_j -1 is outside 0 to 1e"):
        replace(EXAMPLE, pulse_energy_j=-1.0)


def test_radiance_above_a_bright_sky_is_no_radiance_in_si() -> None:
    """Sunlit white paper is below the limit, a lamp of a picture's scene far above it."""
    paper = sunlight_w_per_m2_nm(1e5, 850e-9) / math.pi
    lit = transient_of([(2.0, 2.1, 3e-4)], [(4.0, 4.0, 2e-4)], ambient=[paper, paper])
    assert 0.2 < paper < 0.3 and EXAMPLE.budget(lit, SENSOR).background > 1e6
    with pytest.raises(InputError) as error:
        EXAMPLE.budget(replace(lit, ambient=np.full((1, 2), 1.4, np.float32)), SENSOR)
    words = ("1.4 W/(m2 sr nm)", "above 0.5", "--signal and --background instead of --radiometric")
    assert all(word in str(error.value) for word in words) and "\n" not in str(error.value)
