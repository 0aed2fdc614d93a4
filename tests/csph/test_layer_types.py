"""The layer in other types of number, on the meta device and compiled, and models on an empty batch."""

import copy

import pytest
import torch

from csph.codes.design import Design
from csph.layer import CompressiveLayer
from csph.networks.config import ModelConfig
from csph.networks.model import DepthModel
from scenes.errors import InputError

DESIGNS = (
    Design("learned", (16, 2, 2), 8),
    Design("learned", (16, 2, 2), 6, full=True),
    Design("fourier", (32, 1, 1), 6),
)
SWITCHES = ({}, {"int8": True}, {"pulse_in_codes": True, "pulse_in_decoder": True})
CASES = [  # int8 is for factors
    pytest.param(design, switches, id="-".join([design.name, *switches]))
    for design in DESIGNS
    for switches in SWITCHES
    if not (design.full and switches.get("int8"))
]
MODELS = {
    "compact": ModelConfig(design=Design("learned", (64, 2, 2), 8)),
    "blockwise": ModelConfig(design=Design("learned", (64, 2, 2), 8), network="blockwise"),
    "refined": ModelConfig(design=Design("learned", (64, 2, 2), 8), network="refined"),
    "periodic": ModelConfig(design=Design("fourier", (1024, 1, 1), 8), network="periodic", layer={"keep_mean": True}),
    "published": ModelConfig(front="counts", network="published"),
    "matched": ModelConfig(front="matched"),
    "peak": ModelConfig(front="peak"),
}


def counts(columns: int = 8) -> torch.Tensor:
    return torch.poisson(torch.ones(2, 1, 32, 8, columns), torch.Generator().manual_seed(1))


def outcome(layer: CompressiveLayer, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return codes, back-projection, and derivatives of the latter by counts and weights."""
    x = x.clone().requires_grad_()
    back = layer(x)
    # weights that no symmetry of the sum makes vanish
    wanted = (back * torch.linspace(-1, 1, back.numel()).view(back.shape)).sum()
    return layer.encode(x), back, *torch.autograd.grad(wanted, [x, *layer.parameters()])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize(("design", "switches"), CASES)
def test_weights_of_16_bits_compute_as_the_same_weights_in_float32(design, switches, dtype):
    """1003 counts were 1004 in bfloat16, and 1e5 counts in a bin infinite in float16."""
    half = CompressiveLayer.of(design, **switches).to(dtype)
    whole = copy.deepcopy(half).float()
    x = counts()
    x[0, 0, 3, 2, 1], x[1, 0, 9, 0, 0] = 1003, 1e5
    for name, given in (("float", x), ("whole numbers", x.int())):
        assert half.encode(given).dtype == half(given).dtype == torch.float32, name
        assert torch.equal(half.encode(given), whole.encode(given)) and torch.equal(half(given), whole(given)), name
    assert half(x).isfinite().all()
    codes = whole.encode(x)
    assert torch.equal(half.decode(codes), whole.decode(codes))
    assert torch.equal(half.encode_mean(x), whole.encode_mean(x))
    for mine, theirs in ((half.coding(), whole.coding()), (half.raw_coding(), whole.raw_coding())):
        assert torch.equal(mine.tensor, theirs.tensor)
    # encoder and decoder each round their share of a weight's derivative, and so is the sum: three half steps
    rounded, exact = outcome(half, x)[2:], outcome(whole, x)[2:]
    limit = 2 * torch.finfo(dtype).eps * max(one.abs().max() for one in exact)
    assert all((mine - theirs).abs().max() <= limit for mine, theirs in zip(rounded, exact, strict=True))


def test_weights_in_float64_stay_so():
    layer = CompressiveLayer.of(DESIGNS[0]).double()
    assert layer(counts()).dtype == layer.encode(counts()).dtype == torch.float64


@pytest.mark.parametrize("design", DESIGNS, ids=lambda design: design.name)
def test_a_layer_gives_shapes_on_the_meta_device(design):
    layer, x = CompressiveLayer.of(design), counts()
    codes = layer.encode(x)
    layer.to("meta")
    back = layer(x.to("meta"))
    assert back.is_meta and back.shape == x.shape and layer.encode(x.to("meta")).shape == codes.shape
    assert layer.decode(codes.to("meta")).shape == x.shape


# pixels of a row are moved 2 and 4 at a time, where not compiled
@pytest.mark.parametrize("columns", [8, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("design", "switches"), CASES)
def test_a_compiled_layer_computes_the_same(design, columns, switches):
    layer, x = CompressiveLayer.of(design, **switches).double(), counts(columns)
    torch.compiler.reset()  # of what other cases compiled of the same code
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    for given in (x, x[:1], x.repeat(2, 1, 1, 1, 1)):  # of several sizes, which are symbols to the compiler
        for mine, theirs in zip(outcome(compiled, given), outcome(layer, given), strict=True):
            # the same products, perhaps summed in another order: what 4096 steps of rounding make
            assert (mine - theirs).abs().max() <= 4096 * torch.finfo(torch.float64).eps * max(1, theirs.abs().max())


@pytest.mark.parametrize("config", MODELS.values(), ids=MODELS)
def test_a_model_of_an_empty_batch_gives_empty_answers(config):
    model = DepthModel(config)
    empty = torch.zeros(0, 1, 1024, 8, 8)
    assert model(empty).shape == (0, 1024, 8, 8)
    for decoder in ("soft-argmax", "median"):
        assert model.depth_m(empty, decoder).shape == (0, 8, 8)
    if model.layer is not None:
        assert model.depth_of_codes(model.layer.encode(empty)).shape == (0, 8, 8)
    else:
        with pytest.raises(InputError, match=r"\(0, 1024, 8, 8\): expected \(batch, 1, time, rows, columns\)"):
            model(empty[:, 0])
    with pytest.raises(InputError, match=r"^network input of shape \(0, 1, 1024, 8, 8\): .*, each 1 or more$"):
        DepthModel(MODELS["published"]).network(empty)


@pytest.mark.parametrize("config", MODELS.values(), ids=MODELS)
def test_a_model_in_bfloat16_still_answers(config):
    model = DepthModel(config).bfloat16()
    x = torch.poisson(torch.ones(1, 1, 1024, 4, 4), torch.Generator().manual_seed(1))
    with torch.no_grad():
        logits = model(x)
    assert logits.dtype == torch.bfloat16 and logits.isfinite().all()
