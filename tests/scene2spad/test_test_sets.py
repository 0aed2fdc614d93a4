"""Test sets of studies: rendered once, in folders that studies of different extent share."""

import pytest

from scene2spad.networks.test_sets import rendered, rooms
from scenes import InputError


def test_studies_of_different_size_and_count_share_a_folder(tmp_path):
    """`study all` gives every study one folder; a set at another size stands beside the first, not in its way."""
    small = rendered("tabletop", tmp_path, count=1, size=(12, 8))
    large = rendered("tabletop", tmp_path, count=1, size=(16, 12))
    more = rendered("tabletop", tmp_path, count=2, size=(12, 8))
    again = rendered("tabletop", tmp_path, count=1, size=(12, 8))
    assert small.truth_m(0).shape == (8, 12) and large.truth_m(0).shape == (12, 16)
    assert len(more.digests) == 2 and more.digests[:1] == again.digests == small.digests
    assert {path.name for path in tmp_path.iterdir()} == {"tabletop-12x8", "tabletop-16x12"}


def test_rooms_with_a_failed_view_are_not_packed_for_good(tmp_path, monkeypatch):
    """They were, and every model of the folder was trained on fewer views from then on."""
    monkeypatch.setattr("scene2spad.networks.test_sets.make_set", lambda *asked, **more: {"failed": [3, 17]})
    with pytest.raises(InputError, match=r"rooms: views \[3, 17\] could not be rendered"):
        rooms(tmp_path, lambda what, fraction: None)
    assert not (tmp_path / "rooms.h5").exists()
