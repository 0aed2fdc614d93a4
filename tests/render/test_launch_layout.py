"""Sequences of positions and directions: runs of samples without gaps, even for each pixel, for its batches, and for a
block."""

from dataclasses import replace

import numpy as np
import pytest

from render.indirect import camera_paths, integrator
from render.indirect.launch_layout import (
    BLOCK,
    aligned_number,
    block_sequence,
    make_launch,
    positions_in_pixel,
    recurrence,
    sample_order,
    shared_directions,
    traced_members,
)
from render.indirect.schedule import Schedule, least_spp
from render.pipeline import trace
from render.scene.traced_scene import TracedScene, UInt32, dr
from render.settings import Plan, RenderSettings
from scenes.library.catalog import load_scene
from scenes.model import Laser


def _samples(spp: int, batches: int) -> tuple:
    """Return member, sample index and samples a batch of all samples of one block, as arrays."""
    launch = make_launch(np.arange(1), np.arange(1), np.array([spp]), batches)
    index = np.repeat(launch.sample_index, BLOCK)
    member = np.tile(np.arange(BLOCK), spp)
    return UInt32(member), UInt32(index), UInt32(np.repeat(launch.per_batch, BLOCK))


@pytest.mark.parametrize(("spp", "batches"), [(16, 4), (20, 4), (7, 1), (64, 4)])
def test_samples_of_a_block_are_a_run_without_gaps(spp, batches):
    member, index, per_batch = _samples(spp, batches)
    batch, order = sample_order(index, UInt32(batches), per_batch)
    number = block_sequence(member, order).numpy()
    assert sorted(number) == list(range(spp * BLOCK))
    for one in range(batches):  # and so are those of a batch
        part = np.sort(number[batch.numpy() == one])
        assert np.array_equal(part, np.arange(part[0], part[0] + len(part)))


def test_aligned_numbers_of_members_do_not_overlap():
    member, index, per_batch = _samples(20, 4)  # 5 in a batch: runs of 8
    number = aligned_number(member, index, UInt32(4), per_batch).numpy()
    assert np.array_equal(number // 8, member.numpy())
    assert number.max() == 8 * (BLOCK - 1) + 4


def _discrepancy(points: np.ndarray) -> float:
    """Return the rms over a grid of boxes at the origin of the share of points inside less the area."""
    corner = np.linspace(0.1, 1, 10)
    inside = (points[None, None] < np.stack(np.meshgrid(corner, corner), -1)[:, :, None]).all(-1).mean(-1)
    return float(np.sqrt(np.square(inside - np.outer(corner, corner)).mean()))


@pytest.mark.parametrize("kind", ["positions", "block", "member"])
def test_sequences_are_more_even_than_random_points(kind):
    """Random points have an rms of sqrt(a (1 - a) / n) in a box of area a; a recurrence less than half as much."""
    found = []
    for stream in range(20):
        member, index, per_batch = _samples(64, 4)
        order = sample_order(index, UInt32(4), per_batch)[1]
        sequence = positions_in_pixel if kind == "positions" else shared_directions
        points = np.stack([part.numpy() for part in sequence(UInt32(stream), member, order, UInt32(7))], -1)
        found.append(_discrepancy(points if kind == "block" else points[member.numpy() == 5]))
    area = np.outer(*(np.linspace(0.1, 1, 10),) * 2)
    count = 64 * (BLOCK if kind == "block" else 1)
    assert np.mean(found) < 0.5 * np.sqrt((area * (1 - area)).mean() / count)


def test_a_recurrence_is_uniform_over_its_shifts():
    """Every number's point is uniform over random shifts: estimates by it are unbiased."""
    shift = np.random.default_rng(0).integers(1 << 32, size=(2, 20000), dtype=np.uint64).astype(np.uint32)
    points = recurrence(dr.full(UInt32, 1234, 20000), (UInt32(shift[0]), UInt32(shift[1])))
    for values in points:
        counts = np.histogram(values.numpy(), 10, (0, 1))[0]
        assert np.square(counts - 2000).sum() / 2000 < 27.9  # chi-square, 9 degrees of freedom, 1 in 1,000


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 2)])
def test_what_pads_a_small_image_is_not_traced(monkeypatch, width, height):
    """Lanes of its pixels give what all lanes of its block do: each has its own numbers, and sums have no order."""
    room = load_scene("living-room")
    scene = replace(room, camera=replace(room.camera, width=width, height=height), laser=Laser("scan"))
    plan, settings = Plan(4, 64, 2, False, (), 1.0, 0.0), RenderSettings(bounces=4, spp=64, grid=2)
    traced = []

    def indirect() -> np.ndarray:
        samples = trace(TracedScene(scene), plan, settings, seed=3).samples
        return np.bincount(samples.pixel, samples.radiance * (samples.bounces > 1), width * height)

    def counted(pixels: np.ndarray, *, shared: bool) -> int:
        traced.append(traced_members(pixels, shared=shared))
        return traced[-1]

    for module in (camera_paths, integrator):
        monkeypatch.setattr(module, "traced_members", counted)
    alone = indirect()
    assert width * height in traced
    for module in (camera_paths, integrator):
        monkeypatch.setattr(module, "traced_members", lambda pixels, *, shared: BLOCK)
    assert (alone > 0).all()
    np.testing.assert_array_equal(alone, indirect())


@pytest.mark.parametrize("spp", [8, 16])
def test_few_forced_paths_are_shared_where_that_lowers_the_noise(spp):
    """Shared or not, the forced work is spent; a groove under a flash has a fraction of the noise by shared paths."""
    scene = load_scene("corner", width=32, height=24)
    world, pixels = TracedScene(replace(scene, laser=Laser("flood"))), 32 * 24

    def noise_and_schedule(adaptive: bool) -> tuple[float, Schedule]:
        plan = Plan(3, spp, 2, False, (), 1.0, 0.0, adaptive=adaptive)
        given = RenderSettings(bounces=3, spp=spp, grid=2)
        found = [trace(world, plan, given, seed=seed) for seed in range(4)]
        sums = [np.bincount(s.samples.pixel, s.samples.radiance, pixels) for s in found]
        return float(np.square(np.std(sums, axis=0)).sum()), found[0].schedule

    shared, schedule = noise_and_schedule(True)
    alone, even = noise_and_schedule(False)
    assert schedule.reuses_paths.mean() > 0.5 and not even.reuses_paths.any()
    assert schedule.spp.min() >= least_spp(spp) and schedule.cost <= spp
    assert even.cost == spp
    assert shared < alone / 2
