"""The depth networks: the published one against recorded outputs, our writing of it against torch's layers, both
against what they must survive."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from csph.networks.compact import Compact, averages, enlarged, read_out, time_to_channels
from csph.networks.published import DeepBoosting, parameters_of, soft_argmax, transposed_conv_x2
from scene2spad.bench.network import PlainDeepBoosting, gmac
from scenes import InputError


def formula_weights(network: nn.Module) -> None:
    """1.5 sin(0.7 i + j) / sqrt(shape[1] taps), biases 0.01 cos(i + j): tensor j of the published order, element i."""
    with torch.no_grad():
        for j, parameter in enumerate(network.parameters()):
            i = torch.arange(parameter.numel(), dtype=torch.float64)
            fan = parameter[0].numel() if parameter.ndim > 1 else 1
            value = 0.01 * torch.cos(i + j) if parameter.ndim == 1 else 1.5 * torch.sin(0.7 * i + j) / fan**0.5
            parameter.copy_(value.view(parameter.shape))


@pytest.fixture(scope="module")
def recorded(shared_data):
    path = shared_data.parent / "fixtures" / "backbone.npz"
    if not path.is_file():
        pytest.skip(f"no recorded outputs ({path})")
    with np.load(path) as file:
        return {name: torch.from_numpy(file[name]) for name in file.files}


def close(value: torch.Tensor, recorded: torch.Tensor) -> None:
    assert value.shape == recorded.shape
    assert float((value - recorded).abs().max()) <= 1e-5 * float(recorded.abs().max())


@pytest.mark.parametrize("kind", [DeepBoosting, PlainDeepBoosting])
def test_published_outputs(kind, recorded):
    network = kind()
    formula_weights(network)
    with torch.no_grad():
        features = network.multiscale(recorded["x"])
        contracted = network.contract(features)
        boosted = network.boost(contracted)
        logits = network(recorded["x"])
    stages = ((features, "msfeat"), (contracted, "ds4"), (boosted, "blocks"), (logits, "hist"))
    for value, name in stages:
        close(value, recorded[name])
    # the published decoding, i / (T - 1), which ours replaces by bin centres
    weights = torch.linspace(0, 1, 64).view(1, -1, 1, 1)
    close((logits.softmax(1) * weights).sum(1, keepdim=True), recorded["depth"])
    assert float(logits.mean()) == pytest.approx(0.03505275, rel=1e-5)


def test_published_parameters_and_cost():
    network = DeepBoosting()
    assert parameters_of(network) == 568_278 and len(list(network.parameters())) == 144
    assert gmac(PlainDeepBoosting()) == pytest.approx(50.2, abs=0.05)
    assert gmac(network) < 48  # up4 and the last layer are one convolution
    assert gmac(Compact()) <= 1.5


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(1, 4), st.integers(1, 5), st.integers(1, 4), st.integers(0, 9))
def test_doubling_is_the_transposed_convolution(inputs, outputs, times, rows, columns, seed):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, inputs, times, rows, columns, dtype=torch.float64, generator=generator)
    weight = torch.randn(inputs, outputs, 6, 3, 3, dtype=torch.float64, generator=generator)
    expected = nn.functional.conv_transpose3d(x, weight, stride=(2, 1, 1), padding=(2, 1, 1))
    torch.testing.assert_close(transposed_conv_x2(x, weight), expected, rtol=1e-12, atol=1e-12)


def test_initial_weights():
    torch.manual_seed(0)
    network = DeepBoosting()
    # fan-in of a transposed convolution is taken from its output channels: sqrt(2 / (56 x 54)) = 0.0257
    for step, std in zip(network.up, (0.0257, 0.0364, 0.0514, 0.001), strict=True):
        n = step.weight.numel()
        assert float(step.weight.detach().std()) == pytest.approx(std, rel=5 / (2 * n) ** 0.5 + 2e-3)
    assert not any(p.any() for name, p in network.named_parameters() if name.endswith("bias"))


def gradient_size(network: nn.Module, x: torch.Tensor) -> float:
    (soft_argmax(network(x)) ** 2).mean().backward()
    return sum(float(p.grad.abs().sum()) for p in network.parameters() if p.grad is not None)


def test_a_dead_network_stays_dead_and_ours_does_not():
    x = torch.rand(1, 1, 32, 4, 4)
    for final_relu in (True, False):
        torch.manual_seed(1)
        network = DeepBoosting(final_relu=final_relu)
        nn.init.constant_(network.out.bias, -100.0)
        size = gradient_size(network, x)
        assert (size == 0) if final_relu else (size > 0)
        flat = soft_argmax(network(x)).detach()
        assert final_relu == bool((flat == 16).all())  # mid-range of 32 bins


@pytest.mark.parametrize("network", [DeepBoosting(), DeepBoosting(final_relu=False), Compact()])
@pytest.mark.parametrize("size", [(16, 1, 1), (32, 3, 5), (48, 7, 2)])
def test_any_image(network, size):
    network.zero_grad()
    logits = network(torch.randn(2, 1, *size))
    assert logits.shape == (2, *size)
    soft_argmax(logits).mean().backward()
    assert all(bool(p.grad.isfinite().all()) for p in network.parameters())


@pytest.mark.filterwarnings("ignore:TF32")
@pytest.mark.parametrize("kind", [DeepBoosting, Compact])
def test_gradients_in_bf16(kind):
    # without oneDNN, whose bf16 gradients of 3D weights read memory that was never written (torch 2.13, AVX-512 without
    # bf16): training refuses bf16 on a CPU
    torch.manual_seed(0)
    network, x = kind(), torch.rand(2, 1, 32, 8, 8)
    gradients = []
    for enabled in (False, True):
        network.zero_grad()
        with torch.backends.mkldnn.flags(enabled=False):
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                logits = network(x)
            (soft_argmax(logits) ** 2).mean().backward()
        gradients.append(torch.cat([p.grad.double().flatten() for p in network.parameters()]))
    exact, rounded = gradients
    assert bool(rounded.isfinite().all())
    assert float(torch.cosine_similarity(exact, rounded, dim=0)) > 0.98


@pytest.mark.parametrize("network", [DeepBoosting(), Compact()])
@pytest.mark.parametrize("shape", [(1, 1, 40, 4, 4), (1, 2, 32, 4, 4), (32, 4, 4), (1, 1, 32, 0, 4)])
def test_bad_inputs_are_refused(network, shape):
    with pytest.raises(InputError, match="network input of"):
        network(torch.zeros(shape))


def test_soft_argmax_reads_bin_centres():
    logits = torch.full((1, 8, 1, 2), -1e4)
    logits[0, 3, 0, 0] = 0
    logits[0, [1, 2], 0, 1] = torch.log(torch.tensor([0.25, 0.75]))
    torch.testing.assert_close(soft_argmax(logits), torch.tensor([[[3.5, 0.25 * 1.5 + 0.75 * 2.5]]]))
    assert float(soft_argmax(torch.zeros(1, 1024, 1, 1))) == pytest.approx(512)


def test_folding_and_averaging():
    slices = torch.randn(6, 16, 5, 6)
    folded = time_to_channels(slices)
    assert torch.equal(folded, slices) and folded.is_contiguous(memory_format=torch.channels_last)
    near, wide = averages(slices)
    torch.testing.assert_close(near[1, 3, 2, 2], slices[1, 3, 1:4, 1:4].mean())
    torch.testing.assert_close(near[1, 3, 0, 0], slices[1, 3, :2, :2].mean())
    torch.testing.assert_close(wide[1, 3, 2, 2], wide[1, 3, 3, 3])  # the square of 2 x 2 around it
    torch.testing.assert_close(wide[1, 3, 0, 0], slices[1, 3, :4, :4].mean())
    # the last row is a square of its own, of half the pixels
    bottom = nn.functional.pad(slices[:, :, 2:].unflatten(3, (3, 2)).mean(4), (0, 0, 0, 1), mode="replicate")
    torch.testing.assert_close(wide[:, :, 4, 0], bottom.unflatten(2, (2, 2)).mean(3)[..., :2].mean((2, 3)))


def test_enlarging():
    coarse, fine = torch.randn(2, 3, 2, 3), torch.randn(2, 3, 4, 5)
    expected = fine + coarse.repeat_interleave(2, 2).repeat_interleave(2, 3)[..., :5]
    torch.testing.assert_close(enlarged(coarse, fine, (2, 3)), expected)


def test_derivatives_written_by_hand():
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator, requires_grad=True)

    check = torch.autograd.gradcheck
    assert check(time_to_channels, (drawn(2, 16, 3, 2),)) and check(time_to_channels, (drawn(2, 16, 5, 4),))
    assert check(lambda c, f: enlarged(c, f, (2, 3, 4)), (drawn(2, 2, 2, 1, 3), drawn(2, 2, 3, 2, 5)))
    assert check(read_out, (drawn(2, 6, 3), drawn(2, 4, 2, 3), drawn(4, 3), drawn(4), drawn(3, 3), drawn(3)))


def test_reading_out():
    features, slices = torch.randn(2, 15, 3), torch.randn(2, 4, 3, 5)
    fine, gates = nn.Linear(3, 4), nn.Linear(3, 3)
    found = read_out(features, slices, *fine.parameters(), *gates.parameters())
    views = torch.stack([slices, *averages(slices)], 1).flatten(3)
    expected = fine(features).transpose(1, 2) + (gates(features).transpose(1, 2).unsqueeze(2) * views).sum(1)
    torch.testing.assert_close(found, expected)


def test_the_compact_network_begins_with_the_back_projection():
    torch.manual_seed(0)
    x = torch.zeros(1, 1, 64, 8, 8)
    x[:, :, 37] = 5.0
    assert float((soft_argmax(Compact()(x)).detach() - 37.5).abs().max()) < 1


def test_checkpoints_keep_the_names_that_modules_once_had():
    """States of before the modules were renamed are read, and what is written can be read by who has them still."""
    torch.manual_seed(0)
    one, other = Compact(), Compact()
    state = one.state_dict()
    names = {key.partition(".")[0] for key in state}
    assert {"near", "middle", "far", "from_far", "from_middle", "trust"} < names
    assert not {"full_resolution", "quarter_resolution", "skip_gates"} & names
    assert len(state) == len([*one.parameters()])
    other.load_state_dict(state)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    with pytest.raises(RuntimeError, match="Unexpected"):
        other.load_state_dict({**state, "nobody.weight": torch.zeros(1)})
