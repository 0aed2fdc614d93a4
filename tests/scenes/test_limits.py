"""The memory limit is stated, can be changed, and is asked before anything is allocated."""

import numpy as np
import pytest

from scenes import InputError
from scenes.limits import VARIABLE, memory_limit, require_memory


def test_work_beyond_the_limit_is_refused_in_one_line(monkeypatch):
    monkeypatch.setenv(VARIABLE, "1.5")
    require_memory(1.5e9, "a table")
    with pytest.raises(InputError) as error:
        require_memory(2e9, "a table")
    assert str(error.value) == "a table: needs 2 GB of memory, the limit is 1.5 GB; SCENE2SPAD_MEMORY_GB states another"


def test_without_a_stated_limit_it_is_below_the_machines_memory(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert 1e8 < memory_limit() < 1e14
    with pytest.raises(InputError, match="a universe: needs 1e"):
        require_memory(1e30, "a universe")


@pytest.mark.parametrize("bad", ["", "much", "0", "-1", "nan", "inf"])
def test_a_limit_that_is_no_number_is_refused(monkeypatch, bad):
    monkeypatch.setenv(VARIABLE, bad)
    with pytest.raises(InputError, match=VARIABLE):
        memory_limit()


def test_a_container_may_have_less_than_the_machine(monkeypatch, tmp_path):
    from scenes import limits

    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / "least").write_text("1000000\n")
    (tmp_path / "none").write_text("max\n")
    monkeypatch.setattr(limits, "CONTAINER_LIMITS", (tmp_path / "none", tmp_path / "least", tmp_path / "absent"))
    assert memory_limit() == 800_000
    assert np.isfinite(memory_limit())
