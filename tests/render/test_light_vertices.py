"""Paths joined to points that the laser lights: the same light as by chance alone, with less noise where it is wide."""

from dataclasses import replace

import numpy as np
import pytest

from render.indirect import camera_paths as paths
from render.indirect import light_vertices as lit
from render.indirect import reuse as sharing
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.launch_layout import BLOCK, block_order, make_launch
from render.scene.rays import laser_light
from render.scene.traced_scene import Float, TracedScene, UInt32, dr
from scene2spad.bench.hard import oracles
from scenes import Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere

LAMP = Laser("flood", cone_deg=360)
KINDS = ("diffuse", "plastic", "roughplastic", "roughconductor", "dielectric")
VARNISHED = "varnished"  # walls and a metal ball: what x2 reflects of a light vertex depends on the pixel


def room(kind: str = "diffuse", laser: Laser = LAMP, width: int = 12) -> Scene:
    vertices, faces, uv = box((4, 3, 5))
    walls = Surface(vertices + [0, 0, -1.5], faces[:, ::-1], Material(albedo=0.6), uv=uv)
    vertices, faces, _ = sphere(0.4, 3)
    if kind == VARNISHED:
        walls = replace(walls, material=Material("roughplastic", albedo=0.6, roughness=0.15))
        kind = "roughconductor"
    options = {"ior": 1.5} if kind == "dielectric" else {"roughness": 0.2} if kind.startswith("rough") else {}
    ball = Surface(vertices + [0.4, -0.2, -1.6], faces, Material(kind, albedo=0.4, **options))
    return Scene("room", (walls, ball), oracles.camera(width, width, 60), laser)


def points(world: TracedScene, lanes: int = 1 << 18, batches: int = 1) -> lit.LightVertices:
    return lit.sample_light_vertices(world, lanes, batches, (dr.opaque(UInt32, 1), dr.opaque(UInt32, 2)))


class Sum:
    """In place of `IndirectAccumulator`: what every lane adds."""

    lanes = None

    def clamped(self, pixel, batch, path, radiance, active, adding):
        return radiance

    def filtered(self, path, radiance, diffuse):
        return radiance

    def add(self, pixel, batch, path, radiance, active):
        return dr.select(active & dr.isfinite(radiance), radiance, 0)

    def add_total(self, pixel, batch, total):
        self.lanes = total.numpy().astype(np.float64)


def totals(scene: Scene, seed: int, *, reuses_paths: bool, rounds: int = 64, from_m: float | None = None) -> np.ndarray:
    """Return radiance of indirect light in a view's pixels by every round: (rounds, pixels).

    Blocks share all of it, none, or what comes less than `from_m` behind direct light.
    """
    world, pixels = TracedScene(scene), scene.camera.height * scene.camera.width
    blocks = block_order(np.arange(pixels), scene.camera.width)
    count = len(blocks) // BLOCK
    turns = make_launch(np.arange(count), np.arange(count), np.full(count, rounds))
    start = None if from_m is None else dr.opaque(Float, from_m)
    traced = trace_paths(PathTask(world, blocks, turns, 4, seed, reuses_paths=reuses_paths, from_m=start))
    own = Sum()
    sharing.add_lanes(sharing.own_lanes(traced), traced, own, own=True)
    found = own.lanes
    pairs = sharing.select_pairs(traced, reuses_paths=reuses_paths, early=from_m is not None)
    if pairs is not None:
        of_pairs = Sum()
        sharing.add_lanes(sharing.pair_lanes(world, traced, pairs), traced, of_pairs, own=False)
        np.add.at(found, pairs.vertex.numpy(), of_pairs.lanes)
    return found.reshape(count, rounds, BLOCK).swapaxes(0, 1).reshape(rounds, -1)


def test_suffixes_without_light_are_left_out_of_pairs():
    """Under a narrow flash most of a room is dark: pairs with the rest alone give every pixel the same light."""
    scene = room(laser=Laser("flood", cone_deg=20))
    world, count = TracedScene(scene), 12 * 12 // BLOCK
    blocks = block_order(np.arange(12 * 12), 12)
    turns = make_launch(np.arange(count), np.arange(count), np.full(count, 16))
    traced = trace_paths(PathTask(world, blocks, turns, 3, 0, reuses_paths=True))
    every = sharing.all_pairs(dr.width(traced.batch))
    some = sharing.select_pairs(traced, reuses_paths=True, early=False)
    assert some is not None
    assert dr.width(some.vertex) < 0.8 * dr.width(every.vertex)
    sums = []
    for pairs in (every, some):
        light = Sum()
        sharing.add_lanes(sharing.pair_lanes(world, traced, pairs), traced, light, own=False)
        sums.append(np.bincount(pairs.vertex.numpy(), light.lanes, dr.width(traced.batch)))
    assert sums[0].sum() > 0
    np.testing.assert_allclose(sums[1], sums[0], rtol=1e-5)


@pytest.mark.parametrize("cone_deg", [360, 40])
def test_lit_points_cover_what_the_laser_lights(cone_deg):
    """The mean of 1 / density is the area lit: all of a closed room, or the patch that a cone cuts from a wall."""
    vertices, faces, _ = box((4, 3, 5))
    walls = Surface(vertices + [0, 0, -1.5], faces[:, ::-1], Material(albedo=0.6))
    scene = Scene("box", (walls,), oracles.camera(8, 8, 20), Laser("flood", cone_deg=cone_deg))
    found = points(TracedScene(scene)).all()
    assert (found.irradiance.numpy() > 0).mean() > 0.999
    inverse = 1 / found.density.numpy().astype(np.float64)
    area = 2 * (4 * 3 + 4 * 5 + 3 * 5) if cone_deg == 360 else np.pi * (4 * np.tan(np.radians(20))) ** 2
    assert inverse.mean() == pytest.approx(area, abs=4 * inverse.std() / np.sqrt(len(inverse)))


def test_lit_points_carry_the_lasers_light():
    """Irradiance and path are those of `laser_light`; batches have points of their own, spread as evenly."""
    world = TracedScene(room())
    vertices = points(world, 1 << 12, batches=4)
    found = vertices.all()
    _, irradiance, path = laser_light(
        world,
        found.si,
        dr.zeros(UInt32, dr.width(found.path)),
        dr.full(type(found.path > 0), True),
        seen_by_camera=None,
    )
    assert np.array_equal(irradiance.numpy(), found.irradiance.numpy()) and np.array_equal(
        path.numpy(), found.path.numpy()
    )
    each = int(vertices.each.numpy()[0])
    directions = np.array([part.numpy() for part in found.to_laser]).T[: 4 * each].reshape(4, each, 3)
    assert np.abs(directions.mean(axis=1)).max() < 4 / each**0.75  # of independent points 1/sqrt(3 each)
    assert not np.array_equal(directions[0], directions[1])


@pytest.mark.parametrize("reuses_paths", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_joined_paths_carry_the_same_light_with_less_noise(kind, reuses_paths, monkeypatch):
    """Against paths by chance alone, over all blocks; a lamp close to a wall is what chance misses."""
    scene = room(kind)
    joined = totals(scene, 1, reuses_paths=reuses_paths)
    monkeypatch.setattr(paths, "connections_per_vertex", lambda world, reuses_paths: 0)
    plain = totals(scene, 2, reuses_paths=reuses_paths, rounds=128)
    means, errors = zip(*((t.sum(1).mean(), t.sum(1).std() / np.sqrt(len(t))) for t in (joined, plain)), strict=True)
    assert abs(means[0] - means[1]) < 4 * np.hypot(*errors)
    assert joined.var(axis=0).sum() < plain.var(axis=0).sum() / 1.3  # of pixels


@pytest.mark.parametrize("kind", [*KINDS, VARNISHED, "panel"])
def test_shared_paths_carry_the_light_of_own_ones(kind):
    """The same, by the same joined paths: also before a panel whose two sides the heads of one block may see.

    Mitsuba's coated lobes state a density for directions where they reflect nothing: it must not count.
    """
    scene = room("diffuse" if kind == "panel" else kind)
    if kind == "panel":
        corners = np.array([(-1, -0.6, -1.5), (1, -0.6, -1.5), (1, -0.6, -3), (-1, -0.6, -3)])
        coated = Material("roughplastic", albedo=0.5, roughness=0.3)
        scene = replace(scene, surfaces=(scene.surfaces[0], Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), coated)))
    rounds = 1024 if kind == VARNISHED else 512
    own, split = (totals(scene, 1, reuses_paths=reused, rounds=rounds).sum(axis=1) for reused in (False, True))
    error = np.hypot(own.std(), split.std()) / np.sqrt(rounds)
    assert abs(own.mean() - split.mean()) < 4 * error and error < 0.004 * own.mean()


@pytest.mark.parametrize("from_m", [0.05, 0.5, 100.0])
@pytest.mark.parametrize("kind", ["diffuse", "plastic", "roughplastic"])
def test_early_light_may_be_shared_alone(kind, from_m):
    """Under a flash, what comes soon after direct light by the block's paths, the rest by the pixel's own."""
    scene = room(kind, Laser("flood"))
    own, split = (
        totals(scene, 1, reuses_paths=False, rounds=512, from_m=start).sum(axis=1) for start in (None, from_m)
    )
    error = np.hypot(own.std(), split.std()) / np.sqrt(512)
    assert abs(own.mean() - split.mean()) < 4 * error and error < 0.01 * own.mean()


@pytest.mark.parametrize("cone_deg", [30, 120, 360])
def test_any_cone_and_a_displaced_laser(cone_deg, monkeypatch):
    scene = room("roughplastic", Laser("flood", cone_deg=cone_deg, baseline_m=(0.3, 0.1, 0)))
    monkeypatch.setattr(lit, "NARROW_CONNECTIONS", (2, 2))
    joined = totals(scene, 1, reuses_paths=True)
    monkeypatch.setattr(paths, "connections_per_vertex", lambda world, reuses_paths: 0)
    plain = totals(scene, 2, reuses_paths=True, rounds=128)
    means, errors = zip(*((t.sum(1).mean(), t.sum(1).std() / np.sqrt(len(t))) for t in (joined, plain)), strict=True)
    assert abs(means[0] - means[1]) < 4 * np.hypot(*errors)


@pytest.mark.parametrize("mode", ["scan", "line"])
def test_a_laser_that_moves_has_no_lit_points(mode):
    world = TracedScene(room(laser=Laser(mode)))
    assert (
        lit.connections_per_vertex(world, reuses_paths=True)
        == lit.connections_per_vertex(world, reuses_paths=False)
        == 0
    )
    wide, narrow = TracedScene(room()), TracedScene(replace(room(), laser=Laser("flood", cone_deg=60)))
    assert lit.connections_per_vertex(wide, reuses_paths=False) > lit.connections_per_vertex(narrow, reuses_paths=False)


@pytest.mark.parametrize(("reuses_paths", "gain"), [(False, 30), (True, 4)])
def test_light_from_close_to_a_lamp_is_even_on_varnish(reuses_paths, gain, monkeypatch):
    """A small ball close to the lamp lights varnished walls and metal, which paths by chance find seldom."""
    scene = room(VARNISHED)
    vertices, faces, _ = sphere(0.05, 2)
    scene = replace(scene, surfaces=(*scene.surfaces, Surface(vertices + [0, 0, 0.12], faces, Material(albedo=0.8))))
    joined = totals(scene, 1, reuses_paths=reuses_paths, rounds=256)
    monkeypatch.setattr(paths, "connections_per_vertex", lambda world, reuses_paths: 0)
    plain = totals(scene, 2, reuses_paths=reuses_paths, rounds=256)
    errors = (t.sum(1).std() / np.sqrt(len(t)) for t in (joined, plain))
    assert abs(joined.sum(1).mean() - plain.sum(1).mean()) < 4 * np.hypot(*errors)
    assert joined.var(axis=0).sum() < plain.var(axis=0).sum() / gain


def test_weights_are_whole_and_stay_finite():
    """What joining has and what chance keeps add up to 1, also where points touch or are seen edge-on."""
    for cosine, distance2, far, density in (
        (0.5, 2.0, 0.3, 0.1),
        (0, 1, 1, 1),
        (1, 0, 1, 1),
        (1, 1, 0, 1),
        (1, 1, 1, 0),
        (0, 0, 1, 1),
    ):
        lobes = Float(4 / np.pi * cosine)
        lit_there = lit.lit_density(Float(float(density)), Float(float(distance2)), Float(float(far)))
        kept = lit.mis_weight_bsdf(lobes, lit_there)[0]
        assert 0 <= kept <= 1 and np.isfinite(kept)
        assert lit.mis_weight_filtered(Float(1), Float(float(cosine)), lit_there, 4)[0] == pytest.approx(kept, abs=1e-6)
        if lobes[0] + lit_there[0] > 0:
            assert kept == pytest.approx(lobes[0] / (lobes[0] + lit_there[0]), abs=1e-6)
