import os
import sys
from pathlib import Path

import pytest

# Beside other test processes torch takes one thread: two with two threads each on two cores are many times slower.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# the tests' own helpers are imported by name; the packages are installed
sys.path[:0] = [str(Path(__file__).parent / package) for package in ("spad", "scenes", "csph", "support")]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Checks beside the project: skipped where they are absent."""
    folder = Path(os.environ.get("SCENE2SPAD_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no data for checks (set SCENE2SPAD_DATA; looked in {folder})")
    return folder


@pytest.fixture(scope="session")
def warm():
    """A process with everything imported, whose children are killed by tests."""
    from killed import Warm

    process = Warm()
    yield process
    process.close()
