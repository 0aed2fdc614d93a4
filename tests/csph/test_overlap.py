"""Views and scenes that are in training and in validation, and how views and scenes are known again."""

from dataclasses import replace

import numpy as np

from csph.training.overlap import Overlap, overlap, repeated
from csph.training.views import Views, is_seen, read_views, scenes_by_seed, split_views, view_key
from render.transient import Transient
from render.transient.packs import rounded, write_pack
from scene2spad.datasets.planes import random_planes


def noted(view: Transient, number: int, seed: int, **meta: object) -> Transient:
    notes = [f"procedural, train view {number} of seed {seed}: camera {number % 6} of room {number // 6}"]
    return replace(view, meta={"scene": f"rooms/train/{number}", "notes": notes, **meta})


def test_a_view_is_the_same_with_other_mixed_pixels():
    """Two renders of one view, with indirect light and without, may differ in them. Keys of before still count."""
    view = random_planes(1, size=8).transients[0]
    other = replace(view, mixed=~view.mixed)
    assert view_key(view) == view_key(other) and is_seen(other, {view_key(view)})
    old = "3312a961e8a5"
    assert is_seen(view, {old}) and not is_seen(other, {old})
    assert view_key(view) != view_key(view.delayed(1.0))


def test_shared_views_and_scenes_are_counted():
    """By what a view shows; a scene by its surfaces and camera, too, or by its name and its set's seed."""
    views = random_planes(8, size=8, seed=3)
    first, second = split_views(views, 0.5)
    assert overlap([first], [second]) == Overlap(4, 0, 0)
    assert overlap([views], [second]) == Overlap(4, 4, 4)
    assert overlap([first], [Views(views.transients[2:6], views.scenes[2:6])]) == Overlap(4, 2, 2)
    # other cameras in one room; the room of that number of another seed is another
    names = ("rooms/train/room 0",) * 2
    cameras = [[noted(one, number, seed) for number, one in enumerate(second.transients)] for seed in (0, 1)]
    mine, same, other = (Views((a, b), names) for a, b in (cameras[0][:2], cameras[0][2:], cameras[1][2:]))
    assert overlap([mine], [same]) == Overlap(2, 0, 2)
    assert overlap([mine], [other]) == Overlap(2, 0, 0)
    # packs of before keep no notes: one view of one camera tells that all of the scene is known
    digests = [Views((replace(one, meta={"scene_sha256": "a"}),), ("x",)) for one in second.transients[:2]]
    assert overlap(digests[:1], digests[1:]) == Overlap(1, 0, 1)


def test_sets_of_the_same_views_are_known_in_a_folder_and_in_a_pack(tmp_path):
    """Not views under other light, and not sets that share some views alone."""
    views = random_planes(4, size=8)
    folder = Views([rounded(one) for one in views.transients], views.scenes)
    write_pack(((one, {"scene": name}) for one, name in zip(*folder, strict=True)), tmp_path / "planes.h5")
    packed = read_views(tmp_path / "planes.h5")
    first = Views(packed.transients[:3], packed.scenes[:3])
    dark = Views([replace(one, ambient=0 * one.ambient) for one in packed.transients], packed.scenes)
    assert repeated([folder, packed]) == (0, 1) and repeated([first, folder, dark, packed]) == (1, 3)
    assert repeated([folder, first, dark]) is None is repeated([folder])


def test_scenes_of_several_seeds_in_a_pack_are_several(tmp_path):
    plain = random_planes(4, size=8).transients
    views = [
        noted(one, number, seed) for one, (number, seed) in zip(plain, ((0, 0), (1, 0), (0, 5), (1, 5)), strict=True)
    ]
    records = [{**one.meta, "place": "rooms/train/room 0"} for one in views]
    write_pack(zip(views, records, strict=True), tmp_path / "two.h5")
    found = read_views(tmp_path / "two.h5")
    assert found.scenes == ("rooms/train/room 0 of seed 0",) * 2 + ("rooms/train/room 0 of seed 5",) * 2
    # of one seed names stay as they are: results and splits of before hold them
    assert scenes_by_seed(["a", "b"], views[:2]) == ["a", "b"]
    np.testing.assert_array_equal(found.transients[0].depth_m.shape, (8, 8))
