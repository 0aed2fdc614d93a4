"""Run frames to their end, one after the other, and compare what leaves the sensor with the sums of their photons; and
one whose photons come far apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scenes.errors import InputError, require
from ultraphase.array import CoreArray, Frame
from ultraphase.arrivals import TimedCore
from ultraphase.assembly.isa import HALF_LIMITS
from ultraphase.assembly.program import KINDS, Program
from ultraphase.catalog import Method
from ultraphase.chip import ChipSpec
from ultraphase.compiler import Compiled
from ultraphase.core import Core
from ultraphase.products import Tabulated
from ultraphase.tables import INT8_SCALE, block_sum, spatial_sum, weighted_sum

LINKS = ("SEND", "RECV")
_BRIGHT, _PHOTONS = 4, 300  # cores with so many photons; all others have one
_APART = 100  # photons that come one by one
_STEP, _ROUNDED = 128, (63, 64)  # of a block's sum, and what is left of it where rounding changes
_FEW, _TRIED = 20, 2000  # photons a core, and frames of them that are tried for such sums
_PAUSE = 2000  # clocks from one to the next, at most: many turns of an idle loop


def words_put_out(
    program: Program, array: CoreArray, found: Tabulated, random: np.random.Generator
) -> tuple[str, ...] | None:
    """Return the number in RAM that each word is which leaves a core at a frame's end, "" for another and for one that
    has more or fewer bits than its number; None where cores send to their neighbours.

    Four frames run, of the same photons but for the third. Raises InputError where a frame puts out other words after
    others than at first.
    """
    if any(one.name in LINKS for one in program.instructions):
        return None
    array.registers[:] = random.integers(-(1 << 31), 1 << 31, array.registers.shape)
    one, other = (_photons(array.shape[1], found, random) for _ in range(2))
    frames = [array.frame(stamps, offsets) for stamps, offsets, _ in (one, one, other, one)]
    for later in (frames[1], frames[3]):
        _require_same(program, frames[0], later)
    cores = frames[0].out_cores[:, 1]
    if not (frames[0].out.size and np.array_equal(cores, frames[2].out_cores[:, 1])):
        return ()
    words = np.concatenate([frames[0].out, frames[2].out])
    numbers = np.concatenate([held[cores] for _, _, held in (one, other)])
    sizes = np.concatenate([frames[0].out_sizes, frames[2].out_sizes])
    return _named(program, words, sizes, numbers, found.numbers)


def require_idle(
    program: Program,
    tables: Mapping[str, np.ndarray] | None,
    chip: ChipSpec,
    found: Tabulated,
    random: np.random.Generator,
) -> None:
    """Raise InputError unless photons that come far apart, so that the core turns in its idle loop before, between and
    after them, leave what the same photons leave all at once: in RAM, and as words of a core without links."""
    core = TimedCore(program, tables, chip=chip, port=_APART)  # none of them is lost
    stamps = random.integers(0, len(found.table), _APART)
    gaps = np.where(random.random(_APART) < 0.5, random.integers(1, _PAUSE, _APART), 0)
    comes = np.cumsum(gaps) + _PAUSE
    ends = int(comes[-1]) + _PAUSE
    core.registers[:] = random.integers(-(1 << 31), 1 << 31, len(core.registers)).tolist()
    where = f"program {program.name}: photons that come one by one"
    linked = any(one.name in LINKS for one in program.instructions)
    for drain in (False,) if linked else (False, True):
        _clear(core)
        frame = core.timed_frame(comes, stamps, ends, drain=drain)
        require(frame.read == _APART, f"{where} end the frame after {frame.read} of {_APART}")
        if not drain:
            held = np.concatenate([core.contents(part.name) for part in program.state]).astype(np.int64)
            right = found.limited(found.table[stamps].sum(axis=0))
            wrong = np.flatnonzero(held != right)
            numbers = [f"{held[n]} in {found.numbers[n]}, all at once {right[n]}" for n in wrong[:1]]
            require(not numbers, f"{where} leave {''.join(numbers)}")
        require(drain or not frame.out, f"{where} put out words before the frame is over")
    if not linked:
        _clear(core)
        again, _ = core.frame(stamps.tolist())
        require(again == frame.out, f"{where} put out other words than all at once")


def _clear(core: Core) -> None:
    for part in core.program.state:
        core.ram[part.address : part.end] = bytes(part.end - part.address)


def _photons(cores: int, found: Tabulated, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make photons of a row of cores: timestamps, offsets, and the numbers that each core then holds."""
    count = len(found.table)
    bright = min(cores, _BRIGHT)
    lengths = np.where(np.arange(cores) < bright, _PHOTONS, 1)
    single = random.permutation(count)[: cores - bright]
    stamps = np.concatenate([random.integers(0, count, bright * _PHOTONS), single])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    sums = np.add.reduceat(found.table[stamps], offsets[:-1], axis=0)
    return stamps, offsets, found.limited(sums)


def _require_same(program: Program, first: Frame, later: Frame) -> None:
    where = f"program {program.name}: the same photons put out"
    alike = first.out.shape == later.out.shape and np.array_equal(first.out_cores, later.out_cores)
    require(alike, f"{where} {first.out.size} words, and {later.out.size} after another frame")
    different = np.argwhere(first.out != later.out)
    if len(different):
        core, word = different[0]
        values = f"{first.out[core, word]} as word {word}, and {later.out[core, word]} after another frame"
        raise InputError(f"{where} {values}: its end leaves other than it found")


def _named(
    program: Program, words: np.ndarray, word_bits: np.ndarray, numbers: np.ndarray, names: tuple[str, ...]
) -> tuple[str, ...]:
    """Name the number that each word always is, in as many bits: words, their bits and numbers (frames x cores, ...);
    each number once, as far as two are ever different."""
    sizes = np.concatenate([np.full(part.count, 8 * KINDS[part.kind].itemsize) for part in program.state])
    left, found = list(range(len(names))), []
    for word, bits in zip(words.T, word_bits.T, strict=True):
        off = ((word[:, None] - numbers) % (1 << sizes)).astype(bool) | (bits[:, None] != sizes)
        same = np.flatnonzero(~off.any(axis=0)).tolist()
        found.append(next((number for number in same if number in left), same[0] if same else -1))
        left = [number for number in left if number != found[-1]]
    return tuple("" if number < 0 else names[number] for number in found)


def require_block_end(method: Method, temporal: np.ndarray, seed: int = 0) -> None:
    """Raise InputError unless a block of the catalogue's cores puts out the weighted sum of its photons, for random
    weights, and again after another frame; also a sum that leaves 16 bits, at both ends, and sums that are the last to
    be rounded down and the first to be rounded up. A method of single cores `verify` has run to the end."""
    if method.block == (1, 1):
        return
    random, program = np.random.default_rng(seed), method.program()
    cores, matrix = method.block[0] * method.block[1], method.matrix(temporal)
    weights = random.integers(-INT8_SCALE, INT8_SCALE + 1, (*method.block, method.codes))
    weights[..., 0] = INT8_SCALE  # so that bright cores do not cancel
    array = CoreArray(program, method.block, method.tables(temporal, weights))
    one, other = (random.integers(0, matrix.shape[1], (cores, _PHOTONS)) for _ in range(2))
    bright = HALF_LIMITS[1] // int(np.abs(matrix[0]).max())  # photons that a core's own sum still holds
    top, bottom = (np.full((cores, bright), end) for end in (matrix[0].argmax(), matrix[0].argmin()))

    def sums_of(stamps: np.ndarray) -> np.ndarray:
        return matrix[:, stamps].sum(axis=-1).T.reshape(cores, -1, method.codes)

    def rests_of(stamps: np.ndarray) -> np.ndarray:
        return weighted_sum(sums_of(stamps), weights.reshape(cores, method.codes)) % _STEP

    some = [random.integers(0, matrix.shape[1], (cores, _FEW)) for _ in range(_TRIED)]
    edges = [next((stamps for stamps in some if (rests_of(stamps) == rest).any()), one) for rest in _ROUNDED]
    for stamps in (one, one, other, one, top, bottom, *edges, one):
        frame = array.frame(stamps.reshape(-1), np.arange(cores + 1) * stamps.shape[1])
        right = spatial_sum(sums_of(stamps), weights.reshape(cores, method.codes)).reshape(1, -1)
        same = np.array_equal(frame.out, right)
        require(same, f"program {program.name}: a block of cores puts out other than the weighted sum of its photons")


def require_compiled_end(compiled: Compiled, seed: int = 0) -> None:
    """Raise InputError unless the end of a frame of a compiled code's block puts out the weighted sum of what its cores
    hold, in 16 bits a number, and leaves zeros, whatever the registers hold.

    Cores hold random sums; what makes a block's sum as large and as small as it can be; and what makes it the last to
    be rounded down and the first to be rounded up. These need large and odd weights, so that others than the code's are
    run, too. A code of single cores `verify` has run to the end.
    """
    if compiled.block == (1, 1):
        return
    random, tables = np.random.default_rng(seed), compiled.tables(compiled.block)
    cores, region = compiled.block[0] * compiled.block[1], compiled.program.region("codes")
    sums = random.integers(*HALF_LIMITS, (cores, region.count), endpoint=True)
    _require_weighted_sum(compiled, tables, [sums], random)
    shape, step = (*compiled.block, compiled.code.codes), 1 << compiled.code.output_shift
    odd, largest = np.ones(shape, np.int64), np.ones(shape, np.int64)
    if compiled.weights is not None:
        odd = 2 * random.integers(-INT8_SCALE // 2, INT8_SCALE // 2 + 1, shape) + 1
        largest = INT8_SCALE * random.choice([-1, 1], shape)
    for weights in (odd, largest):
        own = np.tile(weights.reshape(cores, -1), region.count // shape[-1])
        # sums of the weights' signs, so that no core's takes away from another's
        ends = [(np.sign(own) * end).clip(*HALF_LIMITS) for end in HALF_LIMITS]
        changed = {} if compiled.weights is None else {"weight": weights}
        held = ends if weights is largest else _rounded_sums(own, step, random)
        _require_weighted_sum(compiled, {**tables, **changed}, held, random)


def _rounded_sums(weights: np.ndarray, step: int, random: np.random.Generator) -> list[np.ndarray]:
    """Make what cores hold, (cores, numbers), so that half a step less 1, and half a step, are left of every weighted
    sum: the first core, whose weights are odd, makes it so."""
    found = []
    inverse = np.array([pow(int(weight), -1, step) for weight in weights[0]])
    for rest in (step // 2 - 1, step // 2):
        held = random.integers(*HALF_LIMITS, weights.shape, endpoint=True)
        left = rest - (held[1:] * weights[1:]).sum(axis=0)
        held[0] = (left * inverse + step // 2) % step - step // 2
        found.append(held)
    return found


def _require_weighted_sum(
    compiled: Compiled, tables: Mapping[str, np.ndarray], every: Sequence[np.ndarray], random: np.random.Generator
) -> None:
    """Run an end of a frame for each of what cores hold, (cores, numbers). Raises as `require_compiled_end` does."""
    program, codes = compiled.program, compiled.code.codes
    array, region = CoreArray(program, compiled.block, tables, chip=compiled.chip), program.region("codes")
    cores, zeros, bits = len(array.ram), array.ram.copy(), 8 * KINDS[region.kind].itemsize
    weights = tables["weight"].reshape(cores, codes) if "weight" in tables else None
    where = f"program {program.name}: the end of its frame"
    for held in every:
        array.ram[:, region.address : region.end] = held.astype(np.int16).view(np.uint8)
        array.registers[:] = random.integers(-(1 << 31), 1 << 31, array.registers.shape)
        frame = array.frame(np.zeros(0, np.int64), np.zeros(cores + 1, np.int64))
        right = block_sum(held.reshape(cores, -1, codes), weights, compiled.code.output_shift).reshape(1, -1)
        same = np.array_equal(frame.out, right) and bool((frame.out_sizes == bits).all())
        require(same, f"{where} puts out other than the weighted sum of what a block's cores hold")
        require(np.array_equal(array.ram, zeros), f"{where} leaves other than zeros")
