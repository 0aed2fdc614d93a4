"""`tools/set_error.py`: the stated error of a set's views beside their true one."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from scene2spad.datasets.rendering import Job, make_set


@pytest.fixture(scope="module")
def set_error():
    spec = importlib.util.spec_from_file_location("set_error", Path(__file__).parents[1] / "tools" / "set_error.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["set_error"] = module
    spec.loader.exec_module(module)
    return module


def test_table_ends_with_medians_and_root_mean_squares(set_error):
    lines = set_error.table([(0, 0.03, 0.04), (6, 0.03, 0.03)]).splitlines()
    assert lines[0] == "view      0: stated 3.00%, true 4.00%, ratio 0.750"
    assert lines[-1] == "median stated 3.00%, true 3.50%, ratio 0.875; root mean square 3.00%, 3.54%"


def test_a_true_error_of_0_has_an_infinite_ratio(set_error):
    assert "true 0.00%, ratio inf" in set_error.table([(0, 0.03, 0.0), (6, 0.03, 0.03)])


def test_a_coarse_set_is_as_wrong_as_it_says(set_error, tmp_path, capsys):
    """One view of few paths and rays: the true error is of the stated one's size; more views are refused."""
    make_set(Job("rooms", 5, 16, 16, bounces=2, spp=4, grid=2, edge_threshold=0.5), 1, tmp_path / "set")
    assert set_error.main([str(tmp_path / "set"), "--views", "2"]) == 2
    assert "views 2 is outside 1 to 1" in capsys.readouterr().err
    assert set_error.main([str(tmp_path / "set"), "--views", "1", "--paths", "64", "--grid", "6"]) == 0
    ratio = float(capsys.readouterr().out.splitlines()[0].split()[-1])
    assert 0.4 < ratio < 2.5
