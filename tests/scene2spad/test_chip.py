"""Trained codes on the chip: shipped models run and equal torch, or are refused with the bytes that they need."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.codes.quantise import quantised
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig
from csph.networks.model import DepthModel
from csph.weights.shipped import shipped_file, shipped_names
from scene2spad.cli import main
from scene2spad.studies.chip.chain import ChipDepth, FastCores, interpret, network_depth
from scene2spad.studies.chip.code import codes_by_torch, compile_model, harmonics_of, headroom_of, with_headroom
from scenes.errors import InputError
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

FITS = {
    "fourier-1024x1x1-128x-s0": (132, 272),
    "fourier-1024x1x1-64x-s0": (252, 288),
    "gray-1024x1x1-128x-s0": (132, 272),
    "fourier-256x1x1-128x-s0": (48, 80),
    "fourier-learned-256x2x2-128x-s0": (141, 137),
    "fourier-learned-256x2x2-64x-s0": (261, 209),
    "fourier-learned-256x4x4-128x-s0": (519, 353),
    "learned-16x4x4-128x-s0": (30, 291),
}  # clocks a photon and bytes of RAM


def shipped(name: str) -> DepthModel:
    return load_model(shipped_file(name))[0]


def view(rows: int = 8, columns: int = 8, mean: float = 0.3, peak: int = 40) -> np.ndarray:
    counts = np.random.default_rng(1).poisson(mean, (rows, columns, 1024)).astype(np.int32)
    counts[..., 400] += peak
    return counts


@pytest.mark.parametrize("name", FITS)
def test_shipped_designs_run_and_equal_torch(name):
    compiled = compile_model(shipped(name), name).compiled
    fast, counts = FastCores.of(compiled), view()
    assert (fast.proofs[0][0].clocks == FITS[name][0]).all() and compiled.layout.total == FITS[name][1]
    found = interpret(counts, compiled)
    assert found.counters.photons == counts.sum()
    assert np.array_equal(found.codes, codes_by_torch(counts, compiled))
    assert np.array_equal(found.codes, fast.frame(counts)[0])


@pytest.mark.parametrize("name", ["fourier-1024x1x1-128x-s0", "fourier-learned-256x2x2-128x-s0"])
def test_sums_that_wrap_are_counted_and_equal_torchs(name):
    compiled = compile_model(shipped(name), name).compiled
    counts = view(4, 4, peak=600)
    found, (fast, over) = interpret(counts, compiled), FastCores.of(compiled).frame(counts)
    assert found.counters.wraps > 0 and over > 0
    assert np.array_equal(found.codes, codes_by_torch(counts, compiled)) and np.array_equal(found.codes, fast)


def design_of(name: str) -> str:
    """A shipped model's name without its seed and what it was trained on."""
    name = name.rsplit("-", 1)[0]
    for trained in ("-mixed", "-periodic", "-published"):
        name = name.removesuffix(trained)
    return name


@pytest.mark.slow
def test_every_shipped_model_compiles_or_is_refused_with_its_bytes():
    fits = set()
    for name in shipped_names():
        try:
            compile_model(shipped(name), name)
            fits.add(name)
        except InputError as refused:
            message = str(refused)
            coded = not name.startswith(("none", "peak"))
            assert "bytes of RAM a core" in message and "512 are there" in message if coded else "no codes" in message
    assert fits >= set(FITS) and all(design_of(name) in set(map(design_of, FITS)) for name in fits)


def test_full_tensors_and_coarse_histograms_run_and_equal_torch():
    for design in (Design("learned", (16, 2, 2), 2, full=True), Design("coarse", (1024, 1, 1), 16)):
        compiled = compile_model(DepthModel(ModelConfig(design=design)), design.name).compiled
        for counts in (view(), view(4, 4, peak=600)):
            found = interpret(counts, compiled)
            assert np.array_equal(found.codes, codes_by_torch(counts, compiled))
            assert np.array_equal(found.codes, FastCores.of(compiled).frame(counts)[0])


def test_tables_are_the_quantised_factors():
    model = shipped("fourier-learned-256x2x2-128x-s0")
    compiled, steps = compile_model(model, "it").compiled, quantised(model.layer.coding())
    assert np.array_equal(np.moveaxis(compiled.weights, -1, 0), steps.spatial)
    assert np.array_equal(compiled.tables((2, 2))["quarter"], steps.temporal[0, :64])
    assert compiled.code.harmonics == (1, 2, 3, 4)
    gray = compile_model(shipped("gray-1024x1x1-128x-s0"), "gray").compiled
    assert gray.code.harmonics == (1, 2, 4, 8)


def test_codes_that_hold_the_pulse_are_no_quarter_wave():
    design = Design("fourier", (64, 1, 1), 8)
    model = DepthModel(ModelConfig(design=design, layer={"pulse_in_codes": True}))
    assert harmonics_of(design, quantised(model.layer.coding()).temporal, Sensor()) == ()


@pytest.mark.parametrize("block", [(1024, 1, 1), (256, 2, 2)])
def test_codes_trained_for_the_chip_run_with_the_ranges_that_they_learned(block):
    """Smaller tables, no wraps where the full range wraps, and the integers that training has seen."""
    design = Design("fourier", block, 8)
    plain = compile_model(DepthModel(ModelConfig(design=design)), "plain").compiled
    model = with_headroom(DepthModel(ModelConfig(design=design)), 2)
    chip, counts = compile_model(model, "headroom"), view(4, 4, peak=600)
    found, full = interpret(counts, chip.compiled), interpret(counts, plain)
    assert found.counters.wraps == 0 < full.counters.wraps
    assert np.array_equal(found.codes, codes_by_torch(counts, chip.compiled))
    assert np.array_equal(found.codes, FastCores.of(chip.compiled).frame(counts)[0])
    assert chip.compiled.program.instructions == plain.program.instructions
    odd = np.arange(8) // 2 % 2 == 0  # harmonics that a quarter wave gives exactly
    with torch.no_grad():
        seen = model.layer.encode(torch.from_numpy(counts).permute(2, 0, 1)[None, None])[0].permute(2, 3, 1, 0)
    codes = found.codes.reshape(*found.codes.shape[:2], -1, 8)[..., odd] * chip.scale
    assert np.abs(codes - seen.numpy()[..., odd]).max() <= chip.scale * 0.5001


def test_models_that_have_no_program_are_refused():
    with pytest.raises(InputError, match="no codes to compile"):
        compile_model(DepthModel(ModelConfig(front="counts")), "none")
    with pytest.raises(InputError, match="has no codes to find depth from"):
        DepthModel(ModelConfig(front="counts")).depth_of_codes(torch.zeros(1, 8, 1, 4, 4))
    other = replace(Sensor(), bins=512, period_s=512 * Sensor().bin_width_s)
    short = DepthModel(ModelConfig(design=Design("fourier", (512, 1, 1), 8), sensor=other))
    with pytest.raises(InputError, match="sensor of 512 bins, the chip's timestamps count 1024"):
        compile_model(short, "short")


@pytest.mark.parametrize("name", ["fourier-learned-256x2x2-128x-s0", "fourier-1024x1x1-128x-s0"])
def test_the_network_reads_the_chips_integers_as_its_own_codes(name):
    """Depth is that of the reader on the same photons: integers to codes, back-projection, network, and no bias."""
    model = shipped(name)
    chip, counts = compile_model(model, name), view(16, 16, peak=100)
    histogram = torch.from_numpy(counts).permute(2, 0, 1)[None, None].float()
    with torch.no_grad():
        expected = model.depth_m(histogram)[0].numpy()
        same = chip.reader.depth_m(histogram)[0].numpy()
    found = network_depth(chip, interpret(counts, chip.compiled).codes)
    assert np.abs(found - same).max() < 2e-3  # what rounding to integers leaves
    assert np.abs(np.median(found - expected)) < 1e-3


def test_depth_by_way_of_the_chip_takes_whole_blocks_of_its_sensor():
    by_chip = ChipDepth.of(compile_model(shipped("fourier-learned-256x2x2-128x-s0"), "it"))
    truth = np.full((8, 8), 5.0, np.float32)
    flat = truth < 0, truth.astype(np.float16), truth, truth
    histogram = Histogram(view(peak=100), Sensor(), PhotonBudget(100, 300), truth, *flat)
    depth, wraps = by_chip.depth_of(histogram)
    assert depth.shape == (8, 8) and wraps == 0
    assert np.abs(depth - 400.5 * Sensor().bin_depth_m).max() < 0.05
    odd = Histogram(view(8, 7), Sensor(), histogram.budget, truth[:, :7], *(part[:, :7] for part in flat))
    with pytest.raises(InputError, match="7 x 8 pixels does not divide into the blocks of 2 x 2"):
        by_chip.depth_of(odd)


def test_compile_from_the_command_line(capfd, tmp_path):
    out = tmp_path / "program.txt"
    assert main(["ultraphase", "compile", "fourier-learned-256x2x2-128x-s0", "--out", str(out), "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["differs_from_torch"] == 0 and result["ram_bytes"] == 137 and result["bytes_per_pixel"] == 16
    assert result["clocks_per_photon"] == 141 and "table weight of core (1, 1)" in out.read_text()
    for model, message in (
        ("learned-256x2x2-128x-s0", "needs 2,121 bytes of RAM a core"),
        ("full-learned-256x4x4-128x-s0", "needs 8,449 bytes of RAM a core"),
        ("none-s0", "has no codes"),
        ("missing", "unknown"),
    ):
        assert main(["ultraphase", "compile", model]) == 2
        out, err = capfd.readouterr()
        assert out == "" and len(err.splitlines()) == 1 and message in err
    for options, bits in (((), 1), (("--headroom", "0"), 0), (("--headroom", "2"), 2)):
        assert main(["ultraphase", "compile", "fourier-256x1x1-128x-s0", *options, "--json"]) == 0
        result = json.loads(capfd.readouterr().out)
        quarter = result["listing"].split("; table quarter: ")[1].splitlines()[0]
        assert result["headroom_bits"] == bits and max(map(int, quarter.split())) == round(127 / 2**bits)
        assert result["differs_from_torch"] == 0
    assert (
        headroom_of(with_headroom(DepthModel(ModelConfig(design=Design.named("fourier", (1024, 1, 1), codes=8))), 2))
        == 0
    )
    assert main(["ultraphase", "compile", "fourier-256x1x1-128x-s0", "--headroom", "9"]) == 2
    assert "--headroom 9 is outside 0 to 4" in capfd.readouterr().err
    assert main(["ultraphase", "table", "--headroom", "1"]) == 2 and "for compile" in capfd.readouterr().err
    assert main(["ultraphase", "compile"]) == 2 and "which model?" in capfd.readouterr().err
