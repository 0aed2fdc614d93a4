"""`ultraphase`: assemble, list, run, verify, and what it costs."""

from __future__ import annotations

import logging
from dataclasses import asdict
from itertools import product
from pathlib import Path

from scene2spad.cli.checks import CHECKPOINT, check_model, is_checkpoint
from scene2spad.cli.experiments.ultraphase_inputs import program_of, tables_of
from scene2spad.cli.experiments.ultraphase_run import run_frame
from scene2spad.cli.paths import Mark, begins, check_target, keep_foreign
from scene2spad.emulation.program_tables import all_costs, int8_temporal, verified
from scene2spad.options.common import only_for
from scene2spad.options.experiments import MAX_HEADROOM_BITS, Ultraphase
from scenes.errors import InputError, listed, require
from scenes.files import whole_file
from scenes.json_types import JsonObject
from scenes.progress import Progress
from ultraphase import Method, Tabulated, listing, method, verify
from ultraphase.catalog import PUBLISHED
from ultraphase.chip import ASSUMPTIONS
from ultraphase.frame_end import require_block_end, require_compiled_end
from ultraphase.power import READINGS, Cost, Load, as_csv, measured_cost, power, reference_bits, sweep, table

log = logging.getLogger(__name__)

# What each action writes, as older versions wrote it too.
_POWER_TABLE = Mark("power table", lambda path: begins(path, rb"name,[^\n]*processing_uw"))
_LISTING = Mark("listing", lambda path: begins(path, rb"; [^\n]*: \d+ of \d+ words, "))
_WORDS = Mark("list of words", lambda path: begins(path, rb"([0-9a-f]{8}\n|\n)+\Z"))
_WRITES = {"table": _POWER_TABLE, "sweep": _POWER_TABLE, "asm": _WORDS, "list": _LISTING, "compile": _LISTING}


def run(command: Ultraphase, progress: Progress) -> dict:
    """Run the command: one action; see `Ultraphase`."""
    actions = {"table": _table, "run": run_frame, "asm": _asm, "list": _list, "verify": _verify, "sweep": _sweep}
    actions["compile"] = _compile
    where = f"ultraphase {command.action}"
    only_for(command, where, _purposes(command.action))
    needs = command.action in ("compile", "run", "asm", "list", "verify")
    require(bool(command.program) == needs, f"{where}: {_arity(command.action, needs)}")
    if command.action == "compile":
        _check_model(command)
    if command.out is not None:
        table = command.action not in ("table", "sweep") or command.out.suffix.lower() == ".csv"
        require(table, f"{command.out}: the output must end in .csv")
        check_target(command.out, Path(command.program) if needs else None)
        kind = _WRITES[command.action]
        named = command.out.suffix.lower() != ".s"
        require(named, f"{command.out}: .s is for sources, and a {kind.kind} is none; take another ending, as .txt")
        keep_foreign(command.out, kind)
    return actions[command.action](command, progress)


def _check_model(command: Ultraphase) -> None:
    """Refuse what is no model, and a headroom that no code has, before torch is loaded."""
    path, bits = Path(command.program), command.headroom
    good = bits is None or 0 <= bits <= MAX_HEADROOM_BITS
    require(good, f"ultraphase compile: --headroom {bits} is outside 0 to {MAX_HEADROOM_BITS}")
    source = path.suffix == ".s"
    kinds = f"a name of `scene2spad models`, a run's folder or its checkpoint ({CHECKPOINT})"
    require(not source, f"{path}: is a program's source, which `ultraphase list` shows; expected {kinds}")
    check_model(path)
    require(not path.is_file() or is_checkpoint(path), f"{path}: is no trained model, expected {kinds}")


def _purposes(action: str) -> dict[str, tuple[bool, str]]:
    """Return, by option, whether the action takes it and which ones do, for `only_for`."""
    takers = {"headroom": ("compile",), "define": ("asm", "list", "run", "verify"), "out": (*_WRITES,)}
    takers |= {"photons": ("run", "sweep"), "table": ("run", "verify")}
    takers |= dict.fromkeys(("signal", "timestamps", "trace", "watch"), ("run",))
    takers |= dict.fromkeys(("fps", "codes", "pixels"), ("sweep",))
    return {option: (action in actions, ", ".join(actions)) for option, actions in takers.items()}


def _arity(action: str, needs: bool) -> str:
    if action == "compile":
        return "which model? a name of `scene2spad models`, or a checkpoint"
    return "which program? a name such as fourier-16, or a file (.s)" if needs else "takes no program"


def _write(path: Path | None, text: str) -> dict[str, str]:
    if path is None:
        return {}
    with whole_file(path) as beside:
        beside.write_text(text)
    return {"out": str(path)}


def _table(command: Ultraphase, progress: Progress) -> dict:
    rows = table(all_costs(progress))
    step = method("coarse-16-shift-2")
    load = Load()
    per = f"{load.photons:g} photons a frame and pixel, {load.frames_per_s:g} frames a second"
    shown: JsonObject = {
        "load": f"{load.pixels} pixels with a core each, {per}; rates and powers are of all of them",
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
    program, _ = program_of(command)
    words = [f"{word:08x}" for word in program.words]
    regions = {r.name: {"kind": r.kind, "count": r.count, "address": r.address} for r in program.regions}
    written = _write(command.out, "\n".join(words) + "\n")
    return {"program": program.name, "words": words, "ram_bits": program.ram_bits, "ram": regions, **written}


def _compile(command: Ultraphase, progress: Progress) -> dict:
    """Show a trained model's program: what it takes, what it costs, and that it computes the torch path's integers."""
    from csph.networks.checkpoint import load_model
    from csph.weights.cards import checkpoint_of
    from csph.weights.shipped import checkpoint_name
    from scene2spad.studies.chip.chain import measured, trial
    from scene2spad.studies.chip.code import compile_model, headroom_of, listing_with_tables, with_headroom

    path = checkpoint_of(command.program)
    model = load_model(path)[0]
    headroom = headroom_of(model) if command.headroom is None else command.headroom
    model = with_headroom(model, headroom) if headroom else model
    compiled = compile_model(model, checkpoint_name(path)).compiled
    require_compiled_end(compiled)
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
        (rows, columns), (down, right) = compiled.block, compiled.chip.cores
        blocks = f"blocks of {rows} x {columns} cores"
        result["array"] = f"{blocks} need a larger array than the fabricated {down} x {right}"
    if not command.json:
        result["ram"] = str(compiled.layout)
    return {**result, "listing": text, **_write(command.out, text)}


def _list(command: Ultraphase, progress: Progress) -> dict:
    program, _ = program_of(command)
    text = listing(program)
    size = {"program": program.name, "words": len(program.words), "ram_bits": program.ram_bits}
    return {**size, "listing": text, **_write(command.out, text)}


def _verify(command: Ultraphase, progress: Progress) -> dict:
    program, chosen = program_of(command)
    if chosen is not None:
        require(chosen.family != "learned", f"{chosen.name}: its table is learned, there is none to verify it with")
        require(not command.table, f"{chosen.name} has its tables; contents by --table are for source files")
        proof = verified(chosen)
        temporal = int8_temporal(chosen)
        if temporal is not None:
            require_block_end(chosen, temporal)
        return {"verified": True, **proof, "frame_end": "puts out all numbers, in every frame anew"}
    found = verify(program, tables=tables_of(command, program, chosen, None))
    missing = _not_verified(found)
    if missing:
        log.warning("warning: %s: photons are verified, the frame's end is not: %s", program.name, missing)
    return {
        "verified": not missing,
        "name": program.name,
        "states": found.states,
        "timestamps": len(found.table),
        "clocks_mean": float(found.clocks.mean()),
        "adds": {"least": int(found.table.min()), "most": int(found.table.max())},
        "overflow": "saturates" if found.saturates.any() else "wraps",
        "puts_out": None if found.puts_out is None else list(found.puts_out),
        "frame_end": missing or "puts out all numbers, in every frame anew",
    }


def _not_verified(found: Tabulated) -> str:
    """Say what is not known of the frame's end of an own program, whose words may mean anything; nothing: all is."""
    if found.puts_out is None:
        return "its cores send to their neighbours"
    absent = [name for name in found.numbers if name not in found.puts_out]
    other = [f"word {place}" for place, name in enumerate(found.puts_out) if not name]
    parts = [f"no word is {listed(absent)}"] if absent else []
    return ", and ".join([*parts, *([f"{listed(other)} is no number of its RAM"] if other else [])])


def _sweep(command: Ultraphase, progress: Progress) -> dict:
    refused, methods = {}, [method(name) for name in PUBLISHED]
    if command.codes:
        methods = [one for one in methods if one.family == "coarse"]
        for codes in dict.fromkeys(command.codes):
            for family in ("fourier", "separable"):
                try:
                    one = Method(family, codes)
                    one.program()
                    methods.append(one)
                except InputError as reason:
                    refused[f"{family}-{codes}"] = str(reason)
        asked = " ".join(map(str, command.codes))
        none = f"ultraphase sweep: --codes {asked}: no program has so many codes; {next(iter(refused.values()), '')}"
        require(len(refused) < 2 * len({*command.codes}), none)
    for text, values in (("photons", command.photons), ("fps", command.fps), ("pixels", command.pixels)):
        require(len(values) > 0, f"ultraphase sweep: --{text} needs a number")
    for photons, frames_per_s, pixels in product(command.photons, command.fps, command.pixels):
        Load(photons, frames_per_s, pixels)  # refused where it cannot be, before the programs run
    rows = sweep(all_costs(progress, methods), command.photons, command.fps, command.pixels)
    return {"rows": rows, "refused": refused, "readings": READINGS, **_write(command.out, as_csv(rows))}
