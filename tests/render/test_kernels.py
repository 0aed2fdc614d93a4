"""Compiling a kernel takes longer than rendering a small view: from the third view of a set on nothing is compiled."""

from dataclasses import replace

import numpy as np
import pytest

from render.direct.footprints import trace
from render.engine import render
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.launch_layout import BLOCK, block_order, make_launch
from render.scene.traced_scene import TracedScene, dr
from render.settings import RenderSettings
from render.specular.image_method import specular_light
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, rectangle, sphere

SETTINGS = RenderSettings(bounces=3, spp=16, grid=2)


def compiled(work) -> int:
    """How many kernels `work` compiled, or read from the cache on disk for the first time in this process."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        work()
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history, "nothing was recorded"
    return sum(not kernel["cache_hit"] or kernel["cache_disk"] for kernel in history)


def room(
    seed: int, kinds: tuple[str, ...], *, balls: int = 2, detail: int = 2, mirrors: int = 0, roughness: float = 0.1
) -> Scene:
    """A box with balls of random albedo and place, seen from a random place."""
    rng = np.random.default_rng(seed)
    vertices, faces, uv = box((4, 3, 5))
    surfaces = [Surface(vertices - (0, 0, 1.5), faces[:, ::-1], Material(albedo=rng.uniform(0.2, 0.9)), uv=uv)]
    for i in range(balls):
        vertices, faces, uv = sphere(rng.uniform(0.1, 0.3), detail + i % 2)
        material = Material(kinds[i % len(kinds)], albedo=rng.uniform(0.1, 0.9), roughness=roughness)
        surfaces.append(Surface(vertices + rng.uniform((-1, -1, -3), (1, 1, -2)), faces, material, uv=uv))
    for _ in range(mirrors):
        vertices, faces, uv = rectangle()
        surfaces.append(
            Surface(vertices + rng.uniform((-1, -1, -3.9), (1, 1, -3)), faces, Material("conductor"), uv=uv)
        )
    camera = Camera.look_at(rng.uniform(-0.2, 0.2, 3), (0, 0, -2), fov_deg=50, width=24, height=18)
    return Scene("room", tuple(surfaces), camera, Laser())


def rendered(scene: Scene, settings: RenderSettings, seed: int = 0) -> None:
    """Render, and clip a few footprints to their faces: a launch that only views need where cells are large in the
    end."""
    trace(TracedScene(scene), np.arange(5), np.zeros(5, int), np.zeros(5, int), 1, clip=True)
    render(scene, settings, seed=seed)


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("kinds", [("diffuse",), ("plastic", "diffuse", "roughplastic")])
def test_no_kernel_is_compiled_from_the_third_view_on(kinds, filtered):
    """Same size and materials: another pose. Blocks that share paths and blocks that do not have kernels of their own.

    A pilot decides in every view which blocks share: both go first. It would take the filter in some views alone.
    """
    modes = (False,) if filtered else (False, True)
    ways = [replace(SETTINGS, filter=filtered, adaptive=adaptive) for adaptive in modes]
    views = [
        sum(compiled(lambda seed=seed, way=way: rendered(room(seed, kinds), way, seed)) for way in ways)
        for seed in range(4)
    ]
    assert views[2:] == [0, 0], views


@pytest.mark.parametrize("kinds", [("diffuse",), ("plastic", "diffuse", "roughplastic")])
def test_albedos_objects_and_triangles_compile_nothing(kinds):
    """Other scenes of a set, with the same kinds of material: more objects, more triangles, other albedos."""
    scenes = [
        room(7, kinds, balls=3),
        room(8, kinds, balls=4),
        room(9, kinds, balls=7),
        room(10, kinds, detail=3, balls=5),
    ]
    views = [compiled(lambda scene=scene: rendered(scene, SETTINGS)) for scene in scenes]
    assert views[2:] == [0, 0], views


@pytest.mark.parametrize("filtered", [False, True])
def test_polished_metal_compiles_nothing_from_the_third_view_on(filtered):
    """Highlights and caustics, whose launches are as long as what the view shows of the metal."""
    settings, kinds = replace(SETTINGS, filter=filtered), ("roughconductor", "diffuse")
    scenes = [room(seed, kinds, balls=3, roughness=0.03) for seed in range(5)]
    views = [compiled(lambda scene=scene: rendered(scene, settings)) for scene in scenes]
    assert views[2:] == [0, 0, 0], views


def test_specular_light_compiles_nothing_from_the_third_view_on():
    views = [compiled(lambda s=s: specular_light(TracedScene(room(s, ("plastic",), mirrors=2)), 2)) for s in range(4)]
    assert views[2:] == [0, 0], views


def test_launches_of_any_size_are_recorded_once():
    """Dr.Jit records anew where a launch is as long as one of the scene's arrays and an earlier one was not."""
    world = TracedScene(room(14, ("plastic", "diffuse", "roughplastic"), balls=5))
    sizes = {len(values) for surface in world.scene.surfaces for values in (surface.faces, surface.vertices.ravel())}
    for size in sorted({*range(1, 70), *sizes, *(2 * len(s.vertices) for s in world.scene.surfaces)}):
        column = np.arange(size) % 24
        trace(world, column, np.zeros(size, int), np.zeros(size, int), 1)
    assert world.recordings.calls["footprints", False, False].n_recordings == 1


@pytest.mark.parametrize("laser", [Laser(), Laser(cone_deg=360)], ids=["flash", "lamp"])
def test_launches_of_paths_are_recorded_once_and_replayed_as_they_would_be_traced(laser):
    """Dr.Jit records anew where a launch is as long as a mesh or a table of the scene; none of these is, nor is a
    pilot's, which has one path a pixel, as long as the laser's intensity by pixel."""
    scene = replace(room(21, ("plastic", "diffuse", "roughplastic"), balls=3), laser=laser)
    world, pixels = TracedScene(scene), block_order(np.arange(24 * 18), 24)
    for blocks, rounds in [(1, 3), (2, 8), (2, 16), (5, 5), (16, 1), (27, 1), (27, 4)]:
        block = np.arange(blocks)
        turns = make_launch(block, block, np.full(blocks, rounds), 2)
        ours, new = (
            trace_paths(PathTask(w, pixels[: blocks * BLOCK], turns, 4, 3, 2)) for w in (world, TracedScene(scene))
        )
        for name in ("own_value", "own_onward", "values", "paths", "soonest_m"):
            assert np.array_equal(getattr(ours.suffixes, name).numpy(), getattr(new.suffixes, name).numpy()), name
        assert np.count_nonzero(ours.suffixes.values.numpy()) > 0
    recorded = {key: call.n_recordings for key, call in world.recordings.calls.items()}
    assert len(recorded) == 3 and set(recorded.values()) == {1}, recorded


def test_the_next_world_takes_plastics_and_renders_the_same():
    """Their tables are those of equal parameters, whatever the albedo; cut-outs have tables of their own."""
    first, second = (room(seed, ("plastic", "diffuse", "roughplastic"), balls=4) for seed in (15, 16))
    plastics = TracedScene(first).plastics
    handed = TracedScene(second, plastics=plastics)
    assert len(plastics) == 2 and all(handed.plastics[key] is made for key, made in plastics.items())
    settings = RenderSettings(bounces=3, spp=16, grid=2)
    assert render(second, settings, world=handed).sha256() == render(second, settings).sha256()
    pane = replace(first.surfaces[-1], material=Material("plastic", opacity=0.3))
    assert not TracedScene(replace(first, surfaces=(first.surfaces[0], pane)), cutouts_by_mitsuba=True).plastics
