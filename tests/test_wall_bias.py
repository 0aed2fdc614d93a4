"""`tools/wall_bias.py`: the bias of networks before plane walls."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def wall_bias():
    spec = importlib.util.spec_from_file_location("wall_bias", Path(__file__).parents[1] / "tools" / "wall_bias.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_line_of_a_model(wall_bias):
    errors = np.array([[1.0, 3.0], [-5.0, -3.0]])
    expected = "a: largest -4.0 +- 1.0 mm at 2 m, 1 of 2 walls beyond 3 mm, root mean square 3.2 mm (noise 1.0 mm)"
    assert wall_bias.summary("a", np.array([1.0, 2.0]), errors) == expected


def test_a_network_on_all_bins_has_no_bias(wall_bias, capsys):
    """Two walls; what is no depth, or no model, is one line."""
    assert wall_bias.main(["none-mixed-s0", "--from", "2", "--to", "9", "--step", "7", "--draws", "2"]) == 0
    assert "none-mixed-s0: largest" in (told := capsys.readouterr().out)
    assert "0 of 2 walls beyond 3 mm" in told
    assert wall_bias.main(["none-mixed-s0", "--from", "5", "--to", "4"]) == 2
    assert "depths from 5 to 4 m: none" in capsys.readouterr().err
    for wrong, said in (
        (["--to", "inf"], "to inf m: none"),
        (["--step", "nan"], "step nan m"),
        (["--step", "1e-9"], "walls, expected 1000 at most"),
        (["--draws", "0"], "draws 0 is outside 1 to 1000"),
    ):
        assert wall_bias.main(["none-mixed-s0", *wrong]) == 2
        assert said in capsys.readouterr().err
    assert wall_bias.main(["nothing-s0"]) == 2
    assert "is unknown" in capsys.readouterr().err
