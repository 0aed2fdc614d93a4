"""`bench render`: error against seconds, ours beside mitransient, on the same scenes, bins and machine, in one run."""

from __future__ import annotations

import json
import logging
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from render.scene.traced_scene import TracedScene
from scene2spad.bench.rendering import ours, peers, settings
from scene2spad.bench.rendering.binning import binned
from scene2spad.bench.rendering.curves import Ratio, ratio_at
from scene2spad.bench.rendering.errors import Reference
from scene2spad.bench.rendering.measure import Row, curve, measure_level, our_runner, peer_runner, with_slopes
from scene2spad.bench.rendering.references import default_folder, reference
from scene2spad.bench.rendering.settings import BIN_M, BINS, BOUNCES, METHODS
from scene2spad.options.experiments import Bench
from scenes.errors import InputError
from scenes.files import finite, whole_file, write_csv
from scenes.io.versions import installed_versions
from scenes.model import Scene
from scenes.progress import Progress

log = logging.getLogger("scene2spad")

TARGETS = {"direct": (0.0123, 0.003), "full": ()}  # beside the best error that the peer was measured at
OWN_REFERENCE_GRID = 16
SEEDS_APART = 10_000_000  # runs of one --seed never meet those of another, nor the reference's


@dataclass(frozen=True)
class Case:
    """One panel: a scene at a size."""

    name: str
    size: int
    scene: Scene


def run(command: Bench, progress: Progress) -> dict:
    """Measure every case, write CSV and pictures, and return rows, ratios, checks and the files' names."""
    if command.memory:
        from scene2spad.bench.rendering import memory

        return memory.run(command, progress)
    cases = _cases(command)
    with_peer = _peer_wanted(command)
    if command.out.exists() and not command.out.is_dir():
        raise InputError(f"{command.out}: is a file, expected a folder for the results")
    command.out.mkdir(parents=True, exist_ok=True)
    rows, checks = [], []
    parts = [(case, transport) for case in cases for transport in METHODS]
    for number, (case, transport) in enumerate(parts):

        def report(what: str, fraction: float, c: Case = case, t: str = transport, n: int = number) -> None:
            progress(f"{c.name} {c.size} {t}: {what}", (n + fraction) / len(parts))

        found, check = _measure(case, transport, command, with_peer, report)
        rows += found
        checks.append(check)
        log.info("%s", _check_line(check))
    ratios = _ratios(rows)
    result: dict[str, object] = {"rows": [row.to_dict() for row in rows], "ratios": ratios, "checks": checks}
    result |= _write(rows, command)
    with whole_file(command.out / "bench-render.json") as beside:
        text = json.dumps(finite({**result, "machine": _machine(with_peer)}), indent=1, allow_nan=False)
        beside.write_text(text + "\n")
    if not command.json:
        shown = [r for r in ratios if "multijitter" in r["theirs"] and r["chief"]]
        result |= {"rows": _table(rows), "ratios": [_ratio_line(r) for r in shown]}
        result["checks"] = [_check_line(check) for check in checks]
    return result


def _peer_wanted(command: Bench) -> bool:
    if command.peer == "none":
        return False
    if not peers.available():
        raise InputError(f"mitransient is not installed: {peers.INSTALL}, or --peer none for ours alone")
    return True


def _cases(command: Bench) -> list[Case]:
    for size in command.sizes:
        if not 1 <= size <= 512:
            raise InputError(f"bench: size {size} is outside 1 to 512 pixels")
    cases = []
    chosen: tuple[str, ...] = command.scenes or (*settings.SCENES,)
    for name in chosen:
        sizes = command.sizes or (settings.QUICK_SIZES if command.quick else settings.SIZES)[name]
        try:
            cases += [Case(name, size, settings.bench_scene(name, size, command.data)) for size in sizes]
        except InputError as missing:
            if name in command.scenes:
                raise
            log.warning("%s is left out: %s", name, missing)
    if not cases:
        raise InputError("bench: no scene to measure")
    return cases


def _measure(case: Case, transport: str, command: Bench, with_peer: bool, report: Progress) -> tuple[list[Row], dict]:
    """All methods of one case and transport, and what the reference is and how ours agrees with it."""
    methods = [m for m in METHODS[transport] if m.code == "ours" or with_peer]
    world = TracedScene(case.scene)
    truth = _reference(case, transport, world, command, with_peer, lambda fraction: report("reference", 0.5 * fraction))
    bounces = BOUNCES[transport]
    runners = []
    for method in methods:
        if method.code == "ours":
            runners.append(our_runner(world, method, transport))
        else:
            runners.append(peer_runner(peers.Peer(world, method.sampler, bounces, BINS, BIN_M), method))
    grades = [settings.qualities(m, transport, case.size, command.quick) for m in methods]
    rows: dict[str, list[Row]] = {m.name: [] for m in methods}
    levels = max(map(len, grades))
    for number in range(levels):
        report("timing", 0.5 + 0.5 * number / levels)
        level = [(r, g[number]) for r, g in zip(runners, grades, strict=True) if number < len(g)]
        first = 1 + SEEDS_APART * command.seed
        for runner, quality, values in measure_level(level, truth, command.repeats, command.seeds, first):
            method = runner.method
            row = Row(case.name, case.size, transport, method.name, method.unit, quality, **values)
            rows[method.name].append(row)
    for runner in runners:
        runner.release()
    found = [row for group in rows.values() for row in with_slopes(group)]
    return found, _check(case, transport, truth, found)


def _reference(
    case: Case, transport: str, world: TracedScene, command: Bench, with_peer: bool, progress: Callable[[float], None]
) -> Reference:
    """Two halves made by mitransient, so that ours has no home advantage; by ours alone where it is not wanted."""
    passes, spp = settings.reference_passes(transport, case.size)
    bounces = BOUNCES[transport]
    names = ("mitransient", "mitsuba", "drjit") if with_peer else ("scene2spad", "mitsuba", "drjit")
    parts = {
        "scene": case.scene.digest(),
        "bounces": bounces,
        "bins": BINS,
        "bin_m": BIN_M,
        "spp": spp,
        "maker": "mitransient multijitter" if with_peer else "ours",
        "versions": installed_versions(*names),
    }
    pixels = case.size**2
    if with_peer:
        peer = peers.Peer(world, "multijitter", bounces, BINS, BIN_M)
        maker = f"mitransient multijitter, 2 x {passes * spp} spp"

        def make(seed: int) -> np.ndarray:
            return np.array(peer.histogram(peer.render(spp, seed)))

    else:
        method = METHODS[transport][0]
        quality = OWN_REFERENCE_GRID if transport == "direct" else spp
        passes = 1 if transport == "direct" else passes
        exact = "one deterministic grid: no independent check"
        maker = f"ours, {exact}" if transport == "direct" else f"ours, 2 x {passes * spp} spp: no independent check"

        def make(seed: int) -> np.ndarray:
            return binned(ours.trace(world, method, bounces, quality, seed), pixels, BINS, BIN_M)

    folder = command.cache or default_folder()
    return reference(folder, f"{case.name}-{case.size}-{transport}", parts, passes, make, maker, progress)


def _check(case: Case, transport: str, truth: Reference, rows: list[Row]) -> dict:
    """Return the reference's own noise, and how the best of ours agrees with it: energy ratio and cross nRMSE.

    Cross nRMSE is the distance between the two codes' means: two seeds of ours times two halves of theirs, all noise
    cancelling; of deterministic light, the error itself.
    """
    mine = [row for row in rows if row.method in (settings.OURS_DIRECT.name, settings.UNBIASED.name)]
    best = mine[-1]
    cross = {k: getattr(best, f"{'nrmse' if transport == 'direct' else 'bias'}_{k}") for k in ("raw", "pulse")}
    return {
        "scene": case.name,
        "size": case.size,
        "transport": transport,
        "reference": truth.maker,
        "pixels_left_out": truth.left_out,
        "noise_raw": truth.noise[0],
        "noise_pulse": truth.noise[1],
        "resolution_raw": truth.resolution[0],
        "resolution_pulse": truth.resolution[1],
        "ours": f"{best.method}, {best.unit} {best.quality}",
        "energy_ratio": best.energy_ratio,
        "cross_nrmse_raw": cross["raw"],
        "cross_nrmse_pulse": cross["pulse"],
    }


def _ratios(rows: list[Row]) -> list[dict]:
    """Time ratios at equal error of every pair (ours, theirs), raw and after the pulse.

    At the fixed targets, and at every error that theirs was measured at (`chief`: the best of these, and the targets).
    """
    groups: dict[tuple, dict[str, list[Row]]] = {}
    for row in rows:
        groups.setdefault((row.scene, row.size, row.transport), {}).setdefault(row.method, []).append(row)
    found = []
    for (scene, size, transport), methods in groups.items():
        pairs = [(m, t) for m in methods for t in methods if m.startswith("ours") and not t.startswith("ours")]
        for mine, theirs in pairs:
            for kind in ("raw", "pulse"):
                a, b = curve(methods[mine], kind), curve(methods[theirs], kind)
                measured = [point.error for point in b if point.error > 0]
                best = min(measured, default=0.0)
                for error in (*TARGETS[transport], *measured):
                    ratio: Ratio = ratio_at(a, b, error)
                    at = {"scene": scene, "size": size, "transport": transport, "ours": mine, "theirs": theirs}
                    chief = error in TARGETS[transport] or error == best
                    found.append({**at, "kind": kind, **vars(ratio), "chief": chief})
    return found


def _write(rows: list[Row], command: Bench) -> dict:
    from scene2spad.bench.rendering import picture

    path = write_csv([row.to_dict() for row in rows], command.out / "bench-render.csv")
    names = {"csv": str(path), "results": str(command.out / "bench-render.json")}
    for key, kind in (("figure", "raw"), ("figure_pulse", "pulse")):
        names[key] = str(picture.draw(rows, kind, command.out / f"bench-render-{kind}.png"))
    return names


def _machine(with_peer: bool) -> dict:
    names = ("scene2spad", "mitsuba", "drjit", "numpy", *(("mitransient",) if with_peer else ()))
    return {
        "processor": platform.processor() or platform.machine(),
        "cpus": os.cpu_count(),
        "versions": installed_versions(*names),
    }


def _table(rows: list[Row]) -> list[str]:
    """One line a row, for people."""
    head = f"{'case':<18} {'method':<24} {'quality':>9} {'warm':>9} {'cold':>9}"
    head += f" {'nRMSE':>8} {'+pulse':>8} {'pixel 50%':>9} {'95%':>8} {'bias':>8} {'energy':>8} {'slope':>6}"
    lines = [head]
    for r in rows:
        case = f"{r.scene} {r.size} {r.transport}"
        message = f"{case:<18} {r.method:<24} {r.unit:>4} {r.quality:>4} {_seconds(r.seconds):>9}"
        message += f" {_seconds(r.cold_seconds):>9} {r.nrmse_raw:>8.5f} {r.nrmse_pulse:>8.5f}"
        message += f" {r.pixel_median:>9.5f} {r.pixel_p95:>8.5f} {r.bias_raw:>8.5f} {r.energy_ratio:>8.5f}"
        below = " below the reference's resolution" if r.nrmse_raw <= r.resolution_raw else ""
        lines.append(f"{message} {r.slope_raw:>6.2f}{' flattens: bias' if r.flattens else ''}{below}")
    return lines


def _ratio_line(r: dict) -> str:
    carried = f" ({r['extrapolated']} extrapolated)" if r["extrapolated"] else ""
    sign = ">=" if r["at_least"] else ""
    return (
        f"{r['scene']} {r['size']} {r['transport']}: {r['ours']} {sign}{r['ratio']:.3g}x {r['theirs']} at nRMSE "
        f"{r['error']:.4g} {r['kind']}, {_seconds(r['ours_seconds'])} against {_seconds(r['theirs_seconds'])}{carried}"
    )


def _check_line(c: dict) -> str:
    left_out = f" ({c['pixels_left_out']} pixels with fireflies left out)" if c["pixels_left_out"] else ""
    return (
        f"{c['scene']} {c['size']} {c['transport']}: reference {c['reference']}{left_out}, noise "
        f"{c['noise_raw']:.2g}, resolves {c['resolution_raw']:.2g} raw, {c['resolution_pulse']:.2g} after the pulse; "
        f"{c['ours']}: energy ratio {c['energy_ratio']:.5f}, cross nRMSE {c['cross_nrmse_raw']:.2g} raw, "
        f"{c['cross_nrmse_pulse']:.2g} after the pulse"
    )


def _seconds(value: float) -> str:
    return f"{1000 * value:.3g} ms" if value < 1 else f"{value:.3g} s"
