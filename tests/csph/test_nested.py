"""Codes over small blocks as the start of codes over larger ones, and separable tensors as that of full ones."""

from dataclasses import replace

import pytest
import torch

from csph.codes.blocks import encode_blocks
from csph.codes.design import Design
from csph.codes.nested import block_parts, holds, nested
from csph.layer import CompressiveLayer
from csph.networks.blockwise import BlockMixer, mixers_for
from csph.networks.config import ModelConfig, preset
from csph.networks.model import DepthModel
from csph.training.beginning import NetworkOf, check_init
from csph.training.loop import DepthTraining
from scenes.errors import InputError
from spad.sensor.model import Sensor

SMALL = Sensor(bins=64, bin_width_s=100e-9 / 64)
INNER = Design("learned", (16, 2, 2), 4)
LARGER = [
    Design("learned", (64, 2, 2), 16),
    Design("learned", (16, 4, 4), 16),
    Design("learned", (32, 4, 2), 16),
    Design("learned", (64, 4, 4), 64, full=True),
    replace(INNER, full=True),
]


def counts(rows: int = 8, columns: int = 8) -> torch.Tensor:
    random = torch.Generator().manual_seed(1)
    return torch.poisson(2 * torch.rand((2, 1, 64, rows, columns), generator=random), generator=random)


@pytest.mark.parametrize("outer", LARGER, ids=lambda one: one.name)
def test_the_codes_of_a_block_are_those_of_its_parts(outer):
    small = CompressiveLayer.of(INNER, seed=3).coding()
    large = nested(small, outer)
    assert large.block == outer.block and large.codes == outer.codes and large.is_full == outer.full
    apart = encode_blocks(counts(), small.tensor)
    times, down, right = (whole // part for whole, part in zip(outer.block, INNER.block, strict=True))
    batch, codes, *parts = apart.shape
    apart = apart.view(batch, codes, parts[0] // times, times, parts[1] // down, down, parts[2] // right, right)
    together = apart.permute(0, 3, 5, 7, 1, 2, 4, 6).flatten(1, 4)  # by part in time, row, column, then by code
    torch.testing.assert_close(encode_blocks(counts(), large.tensor), together, rtol=1e-5, atol=1e-5)
    assert large.tensor.sum(1).abs().max() < 1e-5  # a uniform background still encodes to zero


def test_single_pixels_are_parts_of_blocks():
    one = CompressiveLayer.of(Design("learned", (64, 1, 1), 4), seed=1).coding()
    four = nested(one, Design("learned", (64, 2, 2), 16))
    assert torch.equal(four.tensor[4:8, :, 0, 1], one.temporal)
    assert four.tensor[4:8, :, 1].abs().max() == 0
    longer = nested(one, Design("learned", (128, 1, 1), 8))
    assert longer.spatial is None and torch.equal(longer.temporal[4:, 64:], one.temporal)


def test_which_design_holds_which():
    assert all(holds(outer, INNER) for outer in LARGER)
    assert holds(INNER, Design("fourier", (16, 2, 2), 4))  # learned codes can be any
    assert not holds(Design("fourier", (64, 2, 2), 16), INNER)  # not the other way round
    assert not holds(Design("learned", (64, 2, 2), 8), INNER)  # another compression ratio
    assert not holds(Design("learned", (24, 2, 2), 6), INNER)  # blocks that do not tile
    assert not holds(INNER, replace(INNER, full=True))
    assert not holds(LARGER[0], Design("coarse", (16, 2, 2), 4))  # whose rows do not sum to zero
    assert block_parts((16, 2, 2), (64, 4, 2)) == 8 and block_parts((16, 2, 2), (64, 3, 2)) == 0


def test_a_full_tensor_begins_as_the_separable_one():
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL, network="refined"), 1).eval()
    full = DepthModel(replace(small.config, design=replace(INNER, full=True)), 2).eval()
    full.begin_with(small)
    with torch.no_grad():
        torch.testing.assert_close(full(counts()), small(counts()), rtol=1e-3, atol=1e-3)


def test_a_longer_block_back_projects_light_in_one_part_as_before():
    """Only the normalisation sees the whole block: with light in one part alone, and the codes' mean kept, nothing
    changes there."""
    options = {"keep_mean": True}
    small = CompressiveLayer.of(INNER, seed=3, **options)
    large = CompressiveLayer.of(LARGER[0], seed=5, **options)
    large.begin_within(small.raw_coding(), LARGER[0])
    lit = counts()
    lit[:, :, :32] = lit[:, :, 48:] = 0
    with torch.no_grad():
        before, after = small(lit), large(lit)
    assert before[:, :, 32:48].abs().max() > 0.1
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-4)


def test_mixers_of_a_longer_block_mix_each_part_with_its_codes():
    torch.manual_seed(0)
    small, large = BlockMixer(3, (16, 2, 2), 4), BlockMixer(3, (64, 2, 2), 16)
    for parameter in (small.outer.weight, small.bias):
        torch.nn.init.normal_(parameter)
    states = [{f"early.{name}": value for name, value in one.state_dict().items()} for one in (large, small)]
    assert mixers_for(*states, same_pixels=False) == states[0]  # places in a block of other pixels mean other pixels
    fitted = mixers_for(*states, same_pixels=True)
    large.load_state_dict({name.removeprefix("early."): value for name, value in fitted.items()})
    features = torch.randn((4, 3, 4, 4))
    codes = torch.randn((1, 4, 2, 2, 5))
    codes[..., 4] = 0.7  # the same fraction of light in every part: the whole block's
    whole = torch.cat([codes[..., :4].permute(0, 2, 3, 1, 4).flatten(3), codes[:, 0, ..., 4:]], -1).unsqueeze(1)
    with torch.no_grad():
        torch.testing.assert_close(large(features, whole), small(features, codes), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("design", [LARGER[0], LARGER[1], LARGER[3]], ids=lambda one: one.name)
@pytest.mark.parametrize("network_alone", [False, True])
def test_networks_begin_across_blocks(design, network_alone):
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL, network="refined"), 1)
    torch.nn.init.normal_(small.network.early.outer.weight)
    model = replace(small.config, design=design)
    begun = DepthTraining(preset("smoke", model, crop=8), NetworkOf(small) if network_alone else small).model
    assert torch.equal(begun.network.fine.weight, small.network.fine.weight)
    same = design.block[1:] == INNER.block[1:]
    assert bool(begun.network.early.outer.weight.any()) == same  # other pixels: mixers that add nothing yet
    assert bool(begun(counts()).isfinite().all())


def test_codes_in_8_bits_keep_their_ranges_across_blocks():
    """Ranges that training has narrowed clip the larger block's codes as they did the smaller one's."""
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL, layer={"int8": True}), 1)
    with torch.no_grad():
        small.layer.temporal_range -= 0.5
    large = DepthModel(replace(small.config, design=LARGER[0]), 2)
    large.begin_with(small)
    assert large.layer.temporal_range == small.layer.temporal_range
    ours, theirs = large.layer.quantised(), small.layer.quantised()
    assert ours.scale == theirs.scale


def test_other_switches_are_named_where_they_are_why():
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL), 1)
    model = replace(small.config, design=LARGER[0], layer={"keep_mean": True})
    with pytest.raises(InputError, match=r"cannot begin one of .* on reference: --layer none and keep_mean"):
        check_init(small, preset("smoke", model, crop=8))


def test_other_switches_of_the_same_design_are_warned_of(caplog):
    """In one line; not of the network alone, nor of 8 bits, which are trained for from a model without them."""
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL, layer={"per_pixel_norm": True}), 1)

    def warnings(init: DepthModel | NetworkOf, **switches: bool) -> list[str]:
        caplog.clear()
        with caplog.at_level("WARNING", logger="csph"):
            check_init(init, preset("smoke", replace(small.config, layer=switches), crop=8))
        return [record.getMessage() for record in caplog.records]

    (line,) = warnings(small, keep_mean=True, int8=True)
    named = "with --layer per_pixel_norm begins one with --layer int8, keep_mean"
    assert f"learned 16x2x2 K4, compact {named}" in line and "\n" not in line
    assert "begins one with --layer none" in warnings(small)[0]
    assert (
        "begins one with --layer per_pixel_norm, no zero_mean;"
        in warnings(small, per_pixel_norm=True, zero_mean=False)[0]
    )
    assert not warnings(small, per_pixel_norm=True) and not warnings(small, per_pixel_norm=True, keep_mean=False)
    assert not warnings(small, per_pixel_norm=True, int8=True) and not warnings(NetworkOf(small))


def test_what_cannot_begin_is_refused_in_one_line():
    small = DepthModel(ModelConfig(design=INNER, sensor=SMALL), 1)
    for model in (
        replace(small.config, design=Design("learned", (64, 2, 2), 8)),
        replace(small.config, design=LARGER[0], layer={"keep_mean": True}),
        replace(small.config, design=Design("fourier", (16, 2, 2), 4)),
    ):
        with pytest.raises(InputError, match=r"learned 16x2x2 K4, compact on reference cannot begin one of"):
            check_init(small, preset("smoke", model, crop=8))
