"""The layer against convolutions, and by the laws that every design must keep."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from csph import reference
from csph.codes.blocks import EPSILON, FORMED, back_project, encode_blocks, zero_normalised
from csph.codes.design import Design
from csph.codes.photons import encode_photons, photon_table
from csph.codes.temporal import truncated_fourier
from csph.codes.tensor import CodingTensor
from csph.layer import CompressiveLayer, LayerOptions, make_coding
from scenes.errors import InputError
from spad.sensor.model import Sensor
from spad.sensor.template import binned_pulse

SIZE = (32, 8, 8)
DESIGNS = {
    design.name: design
    for design in (
        Design("learned", (32, 1, 1), 8),
        Design("learned", (8, 1, 1), 4),
        Design("learned", (16, 2, 2), 8),
        Design("learned", (16, 2, 2), 6, full=True),
        Design("learned", (8, 4, 2), 5, full=True),
        Design("learned", (32, 1, 4), 5),
        Design("random", (16, 4, 4), 12),
        Design("fourier", (32, 1, 1), 6),
        Design("fourier", (16, 2, 2), 8),
        Design("gray", (32, 2, 2), 8),
        Design("coarse", (32, 1, 1), 8),
        Design("coarse", (32, 2, 2), 4),
        Design("hadamard", (16, 2, 1), 7),
        Design("learned", (32, 1, 1), 1),
        Design("fourier", (32, 2, 2), 2),
    )
}
layers = st.sampled_from(list(DESIGNS)).map(lambda name: CompressiveLayer.of(DESIGNS[name]))
LAWS = settings(deadline=None, max_examples=25, derandomize=True)


def counts_from(seed: int, batch: int = 2, mean: float = 1.0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).poisson(mean, (batch, 1, *SIZE)))


def photons_of(counts: torch.Tensor, shuffle: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Timestamps and offsets of integer counts (B, 1, T, R, C); in a pixel ascending, or in any order."""
    flat = counts[:, 0].permute(0, 2, 3, 1).reshape(-1, counts.shape[2])
    stamps = torch.arange(flat.shape[1]).repeat(len(flat)).repeat_interleave(flat.reshape(-1))
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), flat.sum(1).cumsum(0)])
    if shuffle is not None:
        rng = np.random.default_rng(shuffle)
        pixel = np.repeat(np.arange(len(flat)), flat.sum(1).numpy())
        stamps = stamps[torch.from_numpy(np.lexsort((rng.random(len(stamps)), pixel)))]
    return stamps, offsets


def rounding(counts: torch.Tensor, layer: CompressiveLayer) -> float:
    """Worst case of a float32 sum of n products, n 2^-24 sum |terms|, for the fullest block."""
    mt, mr, mc = layer.block
    ones = CodingTensor("ones", torch.ones(1, mt, mr, mc))
    most = float(encode_blocks(counts.double(), ones.tensor.double()).max())
    return (mt * mr * mc + 2) * 2**-24 * most * float(layer.weights().detach().abs().max())


# -- against the convolutions that define the layer ---------------------------------------------------------------


def convolved(counts: torch.Tensor, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Codes and back-projection by the plain twin."""
    codes = reference.encode(counts, weights)
    return codes, reference.back_project(codes, weights, EPSILON)


@pytest.fixture(params=[FORMED, 0], ids=["formed", "in two steps"])
def both_routes(request, monkeypatch):
    """Separable tensors formed, as for this little counts, and not."""
    monkeypatch.setattr("csph.codes.blocks.FORMED", request.param)


@pytest.mark.usefixtures("both_routes")
@pytest.mark.parametrize("name", DESIGNS)
def test_layer_equals_strided_convolutions_with_gradients(name):
    layer, counts = CompressiveLayer.of(DESIGNS[name]).double(), counts_from(1)
    for part in (layer.temporal, layer.spatial):
        if part is not None:
            part.requires_grad_()
    parts = [part for part in (layer.temporal, layer.spatial) if part is not None]
    codes, projected = convolved(counts, layer.weights())
    assert torch.allclose(layer.encode(counts), codes, rtol=0, atol=1e-12)
    assert torch.allclose(layer(counts), projected, rtol=0, atol=1e-10)
    along = torch.from_numpy(np.random.default_rng(2).normal(size=counts.shape))
    ours = torch.autograd.grad((layer(counts) * along).sum(), parts)
    theirs = torch.autograd.grad((projected * along).sum(), parts)
    for one, other in zip(ours, theirs, strict=True):
        assert (one - other).abs().max() <= 1e-7 * other.abs().max() + 1e-9


# -- laws ----------------------------------------------------------------------------------------------------------


@LAWS
@given(layers, st.integers(0, 2**32 - 1))
def test_encoding_is_linear(layer, seed):
    one, other = counts_from(seed), counts_from(seed + 1, mean=3)
    both = 2 * one + other
    difference = layer.encode(both) - 2 * layer.encode(one) - layer.encode(other)
    assert difference.abs().max() <= 2 * rounding(both, layer)


@LAWS
@given(layers, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 2.0]), st.booleans())
def test_timestamps_and_histogram_give_the_same_codes(layer, seed, mean, shuffled):
    counts = counts_from(seed, mean=mean)
    stamps, offsets = photons_of(counts, seed if shuffled else None)
    dense, sparse = layer.encode(counts), layer.encode_timestamps(stamps.to(torch.uint16), offsets, SIZE)
    assert sparse.shape == dense.shape
    # no fewer terms than one a detection
    assert (sparse - dense).abs().max() <= 2 * max(1.0, mean) * rounding(counts, layer)


@LAWS
@given(layers, st.integers(0, 2**32 - 1), st.booleans())
def test_order_by_place_and_counts_of_many_time_blocks_change_nothing(layer, seed, shuffled):
    """Both ways through `encode_photons` that tables beyond the cache and many time blocks take."""
    counts = counts_from(seed)
    stamps, offsets = photons_of(counts, seed if shuffled else None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("csph.codes.photons.CACHE_BYTES", 0)
        patch.setattr("csph.codes.photons.MARKED_TIMES", 1)
        sparse = layer.encode_timestamps(stamps, offsets, SIZE)
    assert (sparse - layer.encode(counts)).abs().max() <= 2 * rounding(counts, layer)


@LAWS
@given(layers, st.floats(0.5, 1000))
def test_uniform_background_encodes_to_zero_where_codes_are_zero_mean(layer, level):
    counts = torch.full((1, 1, *SIZE), level)
    vanishes = bool(layer.encode(counts).abs().max() <= 2 * rounding(counts, layer))
    assert vanishes == layer.options.zero_mean


@LAWS
@given(layers, st.integers(0, 31), st.integers(0, 7), st.integers(0, 7), st.sampled_from([1.0, 1e3, 1e6]))
def test_a_lone_return_is_brightest_at_its_bin(layer, t, r, c, photons):
    counts = torch.zeros(1, 1, *SIZE)
    counts[0, 0, t, r, c] = photons
    projected = layer(counts)
    assert projected.abs().max() <= 1 + 1e-5
    if layer.codes >= 4:  # by Cauchy-Schwarz
        assert projected[0, 0, t, r, c] >= projected.max() - 1e-5


def test_a_lone_return_reaches_one_at_its_bin_for_orthonormal_codes():
    layer = CompressiveLayer(CodingTensor("fourier", truncated_fourier(8, 32)))
    for t in range(32):
        counts = torch.zeros(1, 1, 32, 1, 1)
        counts[0, 0, t] = 1e4
        projected = layer(counts).flatten()
        assert projected.argmax() == t and projected[t] >= projected.max() - 1e-5
        assert projected[t] == pytest.approx(1, abs=2e-5)


@pytest.mark.usefixtures("both_routes")
@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16, torch.int32, torch.uint16])
def test_outputs_are_finite_in_the_hard_cases(name, dtype):
    layer = CompressiveLayer.of(DESIGNS[name])
    cases = torch.zeros(4, 1, *SIZE)
    cases[1, 0, 5, 3, 3] = 1
    cases[2, 0, 7] = 1e6 / 64  # a million photons in one time bin
    cases[3] = 7
    for options in ({}, {"per_pixel_norm": True}, {"keep_mean": True}):
        varied = CompressiveLayer.of(DESIGNS[name], **options)
        projected = varied(cases.to(dtype))
        assert projected.isfinite().all() and projected.dtype == torch.float32
        assert (projected[0] == 0).all()
        if any(True for _ in varied.parameters()):
            projected.sum().backward()
            assert all(p.grad.isfinite().all() for p in varied.parameters())
    million = torch.zeros(1, 1, *SIZE)
    million[0, 0, 3, 2, 1] = 1e6
    assert layer(million).isfinite().all()


@pytest.mark.usefixtures("both_routes")
def test_half_precision_counts_are_summed_in_float32():
    layer = CompressiveLayer.of(Design("learned", (32, 2, 2), 8))
    counts = counts_from(5, mean=20)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = layer(counts)
    exact = layer(counts)
    assert inside.dtype == torch.float32 and torch.equal(inside, exact)
    for dtype in (torch.float16, torch.bfloat16):  # counts under 256 are exact in both
        assert torch.equal(layer(counts.to(dtype)), exact)


@pytest.mark.usefixtures("both_routes")
@pytest.mark.parametrize("options", [{}, {"per_pixel_norm": True}, {"pulse_in_codes": True, "pulse_in_decoder": True}])
@pytest.mark.parametrize("design", [Design("learned", (4, 2, 2), 4), Design("learned", (4, 2, 2), 5, full=True)])
def test_gradients_by_finite_differences(design, options):
    layer = CompressiveLayer.of(design, **options).double()
    counts = torch.rand(1, 1, 8, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    names = list(design.learned)

    def run(*parts: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(layer, dict(zip(names, parts, strict=True)), (counts,))

    parts = [getattr(layer, name).detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(run, parts)


def test_gradients_of_the_products_by_counts_codes_and_table():
    generator = torch.Generator().manual_seed(4)
    weights = torch.rand(3, 4, 2, 2, dtype=torch.float64, generator=generator).requires_grad_()
    counts = torch.rand(1, 1, 8, 4, 2, dtype=torch.float64, generator=generator).requires_grad_()
    codes = torch.rand(1, 3, 2, 2, 1, dtype=torch.float64, generator=generator).requires_grad_()
    stamps, offsets = photons_of(torch.ones(1, 1, 8, 4, 2, dtype=torch.int64))
    assert torch.autograd.gradcheck(encode_blocks, (counts, weights))
    assert torch.autograd.gradcheck(back_project, (codes, weights))
    assert torch.autograd.gradcheck(lambda c: zero_normalised(c, 1, over=(2,)), (codes,))
    assert torch.autograd.gradcheck(
        lambda w: encode_photons(stamps, offsets, photon_table(w), (4, 2, 2), (8, 4, 2)), (weights,)
    )
    zero = torch.zeros(3, 5, dtype=torch.float64, requires_grad=True)
    zero_normalised(zero, 0).sum().backward()
    assert (zero.grad == 0).all() or zero.grad.isfinite().all()


# -- switches ------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("both_routes")
def test_two_codes_keep_a_sign_alone_unless_their_mean_stays():
    counts = torch.zeros(1, 1, 32, 1, 1)
    counts[0, 0, 9] = 100
    coding = CodingTensor("two", truncated_fourier(2, 32))
    published = CompressiveLayer(coding)(counts).flatten()
    # within the 1e-5 beside the norms, which is least where the cosine and the sine nearly agree
    assert ((published.abs() - 1).abs() < 2e-4).all()
    kept = CompressiveLayer(coding, options=LayerOptions(keep_mean=True))(counts).flatten()
    angle = 2 * torch.pi * (torch.arange(32) - 9) / 32
    assert torch.allclose(kept, angle.cos(), atol=1e-4)


@pytest.mark.usefixtures("both_routes")
def test_back_projections_of_fourier_series_move_with_a_delay_only_if_their_mean_stays():
    counts = torch.poisson(torch.full((1, 1, 32, 1, 1), 2.0), generator=torch.Generator().manual_seed(0))
    for keep_mean, moves in ((True, True), (False, False)):
        layer = CompressiveLayer(
            CodingTensor("Fourier", truncated_fourier(8, 32)), options=LayerOptions(keep_mean=keep_mean)
        )
        errors = [(layer(counts.roll(d, 2)) - layer(counts).roll(d, 2)).abs().max() for d in range(32)]
        assert (max(errors) < 1e-5) == moves


@pytest.mark.usefixtures("both_routes")
def test_norm_of_a_pixel_tells_which_time_block_holds_the_return():
    counts = torch.ones(1, 1, 32, 1, 1)
    counts[0, 0, 21] += 500
    counts[0, 0, 3] += 1
    design = Design("learned", (8, 1, 1), 6)
    published, whole = (CompressiveLayer.of(design, per_pixel_norm=flag)(counts).flatten() for flag in (False, True))
    blocks = published.view(4, 8).abs().amax(1)
    assert blocks[0] > 0.9 and blocks[2] > 0.9  # one stray photon weighs as much as the return
    assert whole.argmax() == 21 and whole[21] > 0.99 and whole.view(4, 8)[0].abs().max() < 0.02
    # with one time block both are the same
    single = Design("learned", (32, 1, 1), 6)
    assert torch.allclose(*(CompressiveLayer.of(single, per_pixel_norm=flag)(counts) for flag in (False, True)))


@pytest.mark.usefixtures("both_routes")
def test_pulse_aware_weights_are_codes_of_the_returning_pulse():
    sensor = Sensor(name="small", bins=32)
    design = Design("learned", (32, 2, 2), 8)
    plain = CompressiveLayer.of(design, sensor=sensor)
    aware = CompressiveLayer.of(design, sensor=sensor, pulse_in_decoder=True)
    both = CompressiveLayer.of(design, sensor=sensor, pulse_in_codes=True)
    for t in (0, 13, 31):
        pulse = binned_pulse(torch.tensor((t + 0.5) * sensor.bin_width_s, dtype=torch.float64), sensor)
        counts = torch.zeros(1, 1, 32, 2, 2)
        counts[0, 0, :, 1, 0] = 1e5 * pulse
        # the weights at its bin are parallel to the codes of this pulse: 1 but for the 1e-5 beside the norms
        matched = aware(counts).detach()
        assert abs(float(matched[0, 0, t, 1, 0]) - 1) < 1e-3 and int(matched.argmax()) == t * 4 + 2
        assert plain(counts)[0, 0, t, 1, 0] < matched[0, 0, t, 1, 0]
        lone = torch.zeros(1, 1, 32, 2, 2)
        lone[0, 0, t, 1, 0] = 1e5
        assert torch.allclose(both.encode(lone), plain.encode(counts), rtol=1e-4, atol=0.5)


@pytest.mark.parametrize("block", [(32, 1, 1), (8, 2, 2)])
def test_a_known_background_leaves_no_trace(block):
    gate = (torch.arange(32) < 21).float() * torch.linspace(1, 0.3, 32)
    counts = counts_from(8, mean=0.5).float()
    lit = counts + 50 * gate[:, None, None]
    design = Design("learned", block, 6)
    coding = make_coding(design)
    plain, aware = CompressiveLayer(coding), CompressiveLayer(coding, background=gate)
    assert torch.equal(plain.encode(lit), aware.encode(lit))
    assert (plain(lit) - plain(counts)).abs().max() > 0.5
    assert (aware(lit) - aware(counts)).abs().max() < 2e-3  # float32 codes of 50 times the signal
    uniform = CompressiveLayer(coding, background=torch.ones(32))
    assert torch.allclose(uniform(counts), plain(counts), atol=1e-6)


def test_zero_mean_holds_whatever_training_does():
    layer = CompressiveLayer.of(Design("learned", (16, 2, 2), 4, full=True))
    with torch.no_grad():
        layer.temporal += 3
    assert layer.weights().mean(1).abs().max() < 1e-6
    free = CompressiveLayer.of(Design("learned", (16, 2, 2), 4, zero_mean=False))
    assert torch.equal(free.weights(), free.coding().tensor)


def test_the_layers_tensor_comes_back_out_of_it():
    for design in DESIGNS.values():
        layer = CompressiveLayer.of(design)
        coding = layer.coding()
        assert torch.allclose(coding.tensor, layer.weights(), atol=1e-7)
        assert (coding.block, coding.parameters, coding.storage) == (layer.block, design.parameters, design.storage)
    kept = CompressiveLayer.of(DESIGNS["learned 16x2x2 K8"], seed=5).state_dict()
    assert set(kept) == {"temporal", "spatial"}


# -- mistakes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        (torch.zeros(1, 1, 33, 8, 8), "33 x 8 x 8 .* is not tiled by blocks of 16 x 2 x 2"),
        (torch.zeros(1, 1, 32, 7, 8), "32 x 7 x 8"),
        (torch.zeros(1, 2, 32, 8, 8), "expected .batch, 1, time, rows, columns."),
        (torch.zeros(32, 8, 8), r"shape \(32, 8, 8\)"),
        (torch.zeros(1, 1, 0, 8, 8), "expected .batch, 1"),
        (torch.zeros(1, 1, 32, 8, 8, dtype=torch.complex64), "torch.complex64"),
        (torch.zeros(1, 1, 32, 8, 8, dtype=torch.bool), "torch.bool"),
    ],
)
def test_wrong_histograms_end_in_one_line(counts, message):
    with pytest.raises(InputError, match=message) as caught:
        CompressiveLayer.of(DESIGNS["learned 16x2x2 K8"])(counts)
    assert "\n" not in str(caught.value)


def test_wrong_codes_timestamps_and_parts_end_in_one_line():
    layer = CompressiveLayer.of(DESIGNS["learned 16x2x2 K8"])
    with pytest.raises(InputError, match=r"expected \(batch, 8, time, rows, columns\)"):
        layer.decode(torch.zeros(1, 4, 2, 4, 4))
    stamps, offsets = photons_of(counts_from(1))
    for bad, starts, size, message in (
        (stamps, offsets, (33, 8, 8), "not tiled"),
        (stamps, offsets, (32, 8, 6), "no images of 8 x 6"),
        (stamps, offsets, (16, 8, 8), "outside the bins 0 to 15"),
        (stamps.float(), offsets, SIZE, "expected integers"),
        (stamps[:-1], offsets, SIZE, "must rise from 0"),
    ):
        with pytest.raises(InputError, match=message):
            layer.encode_timestamps(bad, starts, size)
    with pytest.raises(InputError, match="no part spatial"):
        CompressiveLayer(CodingTensor("one", torch.ones(2, 4)), learned=("spatial",))
    for background in (torch.zeros(32), torch.ones(30), torch.ones(2, 16)):
        with pytest.raises(InputError, match="background"):
            CompressiveLayer(make_coding(DESIGNS["learned 16x2x2 K8"]), background=background)


@pytest.mark.usefixtures("both_routes")
def test_an_empty_batch_and_views_are_served():
    layer = CompressiveLayer.of(DESIGNS["learned 16x2x2 K8"])
    assert layer(torch.zeros(0, 1, *SIZE)).shape == (0, 1, *SIZE)
    whole = counts_from(4, batch=3).float()
    padded = torch.zeros(3, 1, 33, 9, 9)
    padded[:, :, 1:, 1:, :-1] = whole
    assert torch.equal(layer(padded[:, :, 1:, 1:, :-1]), layer(whole))
    flat = torch.zeros(whole.numel() + 1)
    flat[1:] = whole.reshape(-1)
    assert torch.equal(layer(flat[1:].view(whole.shape)), layer(whole))
