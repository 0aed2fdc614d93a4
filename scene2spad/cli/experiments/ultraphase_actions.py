"""`ultraphase`: assemble, list, run, verify, and what it costs."""

from __future__ import annotations

import logging
import re
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np

from scene2spad.cli.paths import Mark, begins, check_target, keep_foreign
from scene2spad.options.common import only_for
from scene2spad.options.experiments import Ultraphase
from scene2spad.studies.power.program_tables import all_costs, fixed_spatial, int8_temporal, verified
from scenes.errors import InputError, require
from scenes.files import whole_file
from scenes.json_types import JsonObject
from scenes.progress import Progress
from ultraphase import Core, CoreArray, Method, Program, assemble_file, listing, method, verify
from ultraphase.array import Frame
from ultraphase.catalog import PUBLISHED, TIMESTAMPS
from ultraphase.chip import ASSUMPTIONS
from ultraphase.power import READINGS, Cost, Load, as_csv, frame_end, measured_cost, power, reference_bits, sweep, table

log = logging.getLogger(__name__)

_MAX_PHOTONS = 20_000
_MAX_WATCHED = 100
# What each action writes, as older versions wrote it too.
_POWER_TABLE = Mark("power table", lambda path: begins(path, rb"name,[^\n]*processing_uw"))
_LISTING = Mark("listing", lambda path: begins(path, rb"; [^\n]*: \d+ of \d+ words, "))
_WORDS = Mark("list of words", lambda path: begins(path, rb"([0-9a-f]{8}\n|\n)+\Z"))
_WRITES = {"table": _POWER_TABLE, "sweep": _POWER_TABLE, "asm": _WORDS, "list": _LISTING, "compile": _LISTING}


def run(command: Ultraphase, progress: Progress) -> dict:
    """Run the command: one action; see `Ultraphase`."""
    actions = {"table": _table, "run": _run, "asm": _asm, "list": _list, "verify": _verify, "sweep": _sweep}
    actions["compile"] = _compile
    where = f"ultraphase {command.action}"
    only_for(command, where, _purposes(command.action))
    needs = command.action in ("compile", "run", "asm", "list", "verify")
    require(bool(command.program) == needs, f"{where}: {_arity(command.action, needs)}")
    if command.out is not None:
        check_target(command.out, Path(command.program) if needs else None)
        keep_foreign(command.out, _WRITES[command.action])
    return actions[command.action](command, progress)


def _purposes(action: str) -> dict[str, tuple[bool, str]]:
    """Return, by option, whether the action takes it and which ones do, for `only_for`."""
    takers = {"headroom": ("compile",), "define": ("asm", "list", "run", "verify"), "out": (*_WRITES,)}
    takers |= {"photons": ("run", "sweep"), "signal": ("run",), "trace": ("run",), "watch": ("run",)}
    takers |= dict.fromkeys(("fps", "codes", "pixels"), ("sweep",))
    return {option: (action in actions, ", ".join(actions)) for option, actions in takers.items()}


def _arity(action: str, needs: bool) -> str:
    if action == "compile":
        return "which model? a name of `scene2spad models`, or a checkpoint"
    return "which program? a name such as fourier-16, or a file (.s)" if needs else "takes no program"


def load(command: Ultraphase) -> tuple[Program, Method | None]:
    """Return the program of a name or of a source file."""
    if not command.program.endswith(".s"):
        require(not command.define, "constants by --define are for source files")
        chosen = method(command.program)
        return chosen.program(), chosen
    constants = {}
    for text in command.define:
        found = re.fullmatch(r"([A-Za-z_]\w*)=(-?\d{1,9})", text)
        if found is None:
            raise InputError(f"--define {text!r}: expected NAME=VALUE with a whole number")
        constants[found[1]] = int(found[2])
    return assemble_file(Path(command.program), constants), None


def _write(path: Path | None, text: str) -> dict[str, str]:
    if path is None:
        return {}
    with whole_file(path) as beside:
        beside.write_text(text)
    return {"out": str(path)}


def _table(command: Ultraphase, progress: Progress) -> dict:
    rows = table(all_costs(progress))
    step = method("coarse-16-shift-2")
    shown: JsonObject = {
        "rows": rows,
        "references": {
            name: {"bytes_per_pixel": bits / 8, "readout_uw": 1e6 * power(Cost(0, 0, bits), Load()).readout_w}
            for name, bits in reference_bits(Load().photons).items()
        },
        "readings": READINGS,
        "assumptions": ASSUMPTIONS,
        "footnote": {
            "coarse-16 in shifts of 2 bits": {"clocks": measured_cost(step, None).clocks_per_photon, "published": 30}
        },
    }
    shown |= _write(command.out, as_csv(rows))
    if not command.json:
        shown["rows"] = [_row_in_words(row) for row in rows]
    return shown


def _row_in_words(row: dict) -> str:
    printed, ours = row["published"], row["emulated"]
    clocks = f"{printed['clocks']:3d} printed, {ours['clocks']:5.1f} emulated ({row['residual_clocks']:+.1f})"
    processing = (
        f"{printed['processing_uw']:.3g} uW printed, {ours['processing_uw']:.3g} emulated, "
        f"{ours['processing_uw_energy']:.3g} as energy x rate"
    )
    readout = f"{printed['readout_uw']:.2f} / {ours['readout_uw']:.2f} uW"
    return (
        f"{row['name']:13s} clocks a photon {clocks}; {ours['rate_kb_per_s']:5.2f} kB/s; processing {processing}; "
        f"readout {readout}; frame end {ours['frame_end_clocks']:.0f} clocks"
    )


def _asm(command: Ultraphase, progress: Progress) -> dict:
    program, _ = load(command)
    words = [f"{word:08x}" for word in program.words]
    regions = {r.name: {"kind": r.kind, "count": r.count, "address": r.address} for r in program.regions}
    written = _write(command.out, "\n".join(words) + "\n")
    return {"program": program.name, "words": words, "ram_bits": program.ram_bits, "ram": regions, **written}


def _compile(command: Ultraphase, progress: Progress) -> dict:
    """Show a trained model's program: what it takes, what it costs, and that it computes the torch path's integers."""
    from csph.networks.model import load_model
    from csph.weights.cards import checkpoint_of
    from csph.weights.shipped import checkpoint_name
    from scene2spad.studies.chip.chain import measured, trial
    from scene2spad.studies.chip.code import compile_model, headroom_of, listing_with_tables, with_headroom

    path = checkpoint_of(command.program)
    model = load_model(path)[0]
    headroom = headroom_of(model) if command.headroom is None else command.headroom
    model = with_headroom(model, headroom) if headroom else model
    compiled = compile_model(model, checkpoint_name(path)).compiled
    cost, text = measured(compiled), listing_with_tables(compiled)
    result = {
        "model": compiled.name,
        "words": len(compiled.program.words),
        "words_there": compiled.chip.program_words,
        "ram_bytes": compiled.layout.total,
        "ram_bytes_there": compiled.chip.ram_bytes,
        "ram": asdict(compiled.layout),
        "headroom_bits": headroom,
        "loop_order": compiled.loop_order,
        "block_of_cores": compiled.block,
        "clocks_per_photon": cost.clocks_per_photon,
        "clocks_per_frame_end": cost.clocks_per_frame,
        "waits_per_frame_end": cost.waits_per_frame,
        "bytes_per_pixel": cost.bits_per_pixel / 8,
        **trial(compiled, command.seed),
    }
    if not compiled.on_the_chip:
        down, right = compiled.chip.cores
        blocks = f"blocks of {compiled.block[1]} x {compiled.block[0]} cores"
        result["array"] = f"{blocks} need a larger array than the fabricated {right} x {down}"
    if not command.json:
        result["ram"] = str(compiled.layout)
    return {**result, "listing": text, **_write(command.out, text)}


def _list(command: Ultraphase, progress: Progress) -> dict:
    program, _ = load(command)
    text = listing(program)
    size = {"program": program.name, "words": len(program.words), "ram_bits": program.ram_bits}
    return {**size, "listing": text, **_write(command.out, text)}


def _verify(command: Ultraphase, progress: Progress) -> dict:
    program, chosen = load(command)
    if chosen is not None:
        require(chosen.family != "learned", f"{chosen.name}: its table is learned, there is none to verify it with")
        return {"verified": True, **verified(chosen)}
    proof = verify(program)
    return {
        "verified": True,
        "name": program.name,
        "states": proof.states,
        "timestamps": len(proof.table),
        "clocks_mean": float(proof.clocks.mean()),
        "adds": {"least": int(proof.table.min()), "most": int(proof.table.max())},
        "overflow": "saturates" if proof.saturates.any() else "wraps",
    }


def _run(command: Ultraphase, progress: Progress) -> dict:
    """One frame of 2 x 2 cores: photons of one return, the rest spread over all timestamps."""
    program, chosen = load(command)
    require(len(command.photons) == 1, f"ultraphase run: {len(command.photons)} photon counts, expected one")
    photons = command.photons[0]
    good = 0 <= command.signal <= photons <= _MAX_PHOTONS
    require(good, f"{command.signal:g} signal of {photons:g} photons: expected 0 to {_MAX_PHOTONS}, signal among them")
    family = chosen.family if chosen else ""
    require(family not in ("learned", "addressed"), f"{program.name}: has no frame of 2 x 2 pixels to run")
    require(0 <= command.trace <= 100_000, f"--trace {command.trace} is outside 0 to 100000")
    if command.watch:
        program.region(command.watch)  # refused where there is none
    tables: dict[str, np.ndarray] = {}
    if chosen is not None:
        tables = chosen.tables(int8_temporal(chosen), fixed_spatial(chosen))
    streams = [_timestamps(photons, command.signal, command.seed, core) for core in range(4)]
    offsets = np.concatenate([[0], np.cumsum([len(stream) for stream in streams])])
    array = CoreArray(program, (2, 2), tables)
    frame = array.frame(np.concatenate(streams), offsets)
    read, sent = frame.counters.photons, int(offsets[-1])
    if read < sent:
        log.warning(
            "warning: %s halted with %d of %d photons unread: costs are of those read",
            *(program.name, sent - read, sent),
        )
    cost = _cost(program, tables, frame)
    result = {
        "program": program.name,
        "words": len(program.words),
        "ram_bits": program.ram_bits,
        "counters": asdict(frame.counters),
        "clocks_per_photon": cost.clocks_per_photon if read else None,
        "frame_end_clocks": cost.clocks_per_frame,
        "stall_clocks": int(frame.stalls.sum()),
        "out_bits": int(frame.out_bits.sum()),
        "out": frame.out.tolist(),
        "power_30_fps": asdict(power(cost, Load(read / 4))),
    }
    return result | _looked_at(command, program, tables, streams[0])


def _cost(program: Program, tables: dict[str, np.ndarray], frame: Frame) -> Cost:
    """Return the cost of a frame of 2 x 2 cores: its end is all of a frame without photons, the rest its photons'."""
    photons, bits = frame.counters.photons, frame.out_bits.sum() / 4
    clocks = float((frame.cycles - frame.stalls).sum())
    try:
        end = frame_end(program, (2, 2), tables)
        require(4 * end.clocks_per_frame <= clocks, f"{program.name} takes longer without photons")
    except InputError as reason:  # such as a program that reads without asking whether a photon is there
        log.warning("warning: all clocks of the frame are counted as its photons': %s", reason)
        end = Cost(0, 0, 0)
    per_photon = (clocks - 4 * end.clocks_per_frame) / photons if photons else 0.0
    return replace(end, clocks_per_photon=per_photon, bits_per_pixel=bits)


def _timestamps(photons: float, signal: float, seed: int, core: int) -> np.ndarray:
    """Timestamps of one core in the order of detection: round(signal) around bin 300 + 100 core, the rest uniform."""
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(8, core)))
    near = np.rint(random.normal(300 + 100 * core, 1.4, round(signal))).astype(np.int64)
    rest = random.integers(0, TIMESTAMPS, round(photons) - round(signal))
    return random.permutation(np.concatenate([near, rest]) % TIMESTAMPS)


def _looked_at(command: Ultraphase, program: Program, tables: dict, stream: np.ndarray) -> dict:
    """Trace and watch of the first core alone, as far as it runs without its neighbours."""
    shown = {}
    own = {name: values.reshape(-1, values.shape[-1])[0] for name, values in tables.items()}
    if command.trace:
        core = Core(program, own)
        core.start(stream, park=True)
        shown["trace"] = [str(step) for step in core.trace(command.trace)]
    if command.watch:
        core = Core(program, own)
        core.start(stream, park=True)
        changes = zip(range(_MAX_WATCHED), core.watch(command.watch), strict=False)
        shown["watch"] = [f"{step.before.word:4d}  {list(contents)}" for _, (step, contents) in changes]
    return shown


def _sweep(command: Ultraphase, progress: Progress) -> dict:
    refused, methods = {}, [method(name) for name in PUBLISHED]
    if command.codes:
        methods = [one for one in methods if one.family == "coarse"]
        for codes in dict.fromkeys(command.codes):
            for family in ("fourier", "separable"):
                one = Method(family, codes)
                try:
                    one.program()
                    methods.append(one)
                except InputError as reason:
                    refused[one.name] = str(reason)
    for text, values in (("photons", command.photons), ("fps", command.fps), ("pixels", command.pixels)):
        require(len(values) > 0, f"ultraphase sweep: --{text} needs a number")
    for photons, frames_per_s, pixels in product(command.photons, command.fps, command.pixels):
        Load(photons, frames_per_s, pixels)  # refused where it cannot be, before the programs run
    rows = sweep(all_costs(progress, methods), command.photons, command.fps, command.pixels)
    return {"rows": rows, "refused": refused, "readings": READINGS, **_write(command.out, as_csv(rows))}
