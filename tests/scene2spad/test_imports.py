"""What imports what: studies and benches know no command line, and light commands load nothing heavy."""

import ast
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import run_process

from render.transient import write_transient
from spad.formats.rgbd import transient_from_rgbd

ROOT = Path(__file__).parents[2]
MODULES = [path for path in (ROOT / "scene2spad").rglob("*.py") if "cli" not in path.parts and path.name != "start.py"]
HEAVY = ("torch", "mitsuba", "drjit", "matplotlib", "scipy", "h5py", "OpenEXR", "pytorch_lightning", "distributed")


def imported(path: Path) -> set[str]:
    """Names of all modules that a file imports, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_no_study_and_no_bench_imports_the_command_line(path):
    assert not [name for name in imported(path) if name == "scene2spad.cli" or name.startswith("scene2spad.cli.")]


@pytest.mark.parametrize(
    ("command", "allowed"),
    [
        ("--version", ()),
        ("--help", ()),
        ("scenes", ()),
        ("ultraphase table", ()),
        ("ultraphase list fourier-16", ()),
        ("ultraphase verify fourier-8", ()),
    ],
)
def test_a_light_command_loads_nothing_heavy(command, allowed):
    """In a process of its own: torch alone takes two seconds of a processor."""
    code = (
        "import sys; from scene2spad.cli import main\n"
        f"status = main({command.split()!r})\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], status, file=sys.stderr)"
    )
    done = run_process([sys.executable, "-c", code], cwd=ROOT)
    assert done.stderr.splitlines()[-1] == f"{list(allowed)} 0", done.stderr


@pytest.mark.parametrize(
    ("options", "absent"),
    [(("depth", "--no-figure"), "matplotlib"), (("sense",), "torch")],
    ids=("depth without a picture", "sense with one"),
)
def test_depth_and_sense_load_no_renderer_and_sense_no_torch(tmp_path, options, absent):
    image = np.full((4, 4), 0.5)
    write_transient(transient_from_rgbd(2 * image + 1, image, image), tmp_path / "a.exr")
    last = [options[0], "a.h5" if options[0] == "depth" else "a.exr", *options[1:]]
    code = (
        "import sys; from scene2spad.cli import main\n"
        f"assert main(['sense', 'a.exr', '--no-figure']) == 0 == main({last!r})\n"
        f"heavy = ('mitsuba', 'drjit', 'pytorch_lightning', 'distributed', {absent!r})\n"
        "print([name for name in heavy if name in sys.modules], file=sys.stderr)"
    )
    surroundings = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = run_process([sys.executable, "-c", code], cwd=tmp_path, env=surroundings)
    assert done.returncode == 0 and done.stderr.splitlines()[-1] == "[]", done.stderr
