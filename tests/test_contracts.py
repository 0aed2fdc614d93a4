"""Who may import whom: the chain's arrows, no circle, plain twins for tests alone, and no work at import."""

import ast
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# each package, and the packages that it may import
ARROWS = {
    "scenes": set(),
    "render": {"scenes"},
    "spad": {"scenes", "render"},
    "csph": {"scenes", "render", "spad"},
    "ultraphase": {"scenes"},
    "scene2spad": {"scenes", "render", "spad", "csph", "ultraphase"},
}
# of `render`, what others than `scene2spad` may import: none of it imports Mitsuba
WITHOUT_MITSUBA = ("render.transient", "render.settings", "render.backend.malloc", "render.error")
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in ARROWS
    for path in (ROOT / package).rglob("*.py")
}


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"


def nodes(tree: ast.AST, *, deep: bool, types: bool = False) -> list[ast.AST]:
    """All nodes; without those of TYPE_CHECKING blocks unless `types`, and of functions unless `deep`."""
    found, waiting = [], [tree]
    while waiting:
        for node in ast.iter_child_nodes(waiting.pop()):
            if (is_for_types(node) and not types) or (not deep and isinstance(node, ast.FunctionDef)):
                continue
            found.append(node)
            waiting.append(node)
    return found


def modules_named(path: Path, *, deep: bool = True, types: bool = False) -> set[str]:
    """Modules of the project that a file imports."""
    found = set()
    for node in nodes(ast.parse(path.read_text(encoding="utf-8")), deep=deep, types=types):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & FILES.keys() or {node.module}
            found |= {node.module} if inner - FILES.keys() else set()
    return found & FILES.keys()


@cache
def imports() -> dict[str, set[str]]:
    """Read the imports of every file once, and not before a test asks: both processes of the tests import this one."""
    return {name: modules_named(path) for name, path in FILES.items()}


@pytest.mark.parametrize("package", ARROWS)
def test_arrows_never_point_back(package):
    for name, imported in imports().items():
        if name.split(".")[0] == package:
            others = {one.split(".")[0] for one in imported} - {package}
            assert others <= ARROWS[package], (name, others - ARROWS[package])


@pytest.mark.parametrize("package", ["spad", "csph"])
def test_spad_and_csph_run_without_a_renderer(package):
    for name, imported in imports().items():
        if name.split(".")[0] == package:
            used = {one for one in imported if one.split(".")[0] == "render"}
            assert all(one.startswith(WITHOUT_MITSUBA) for one in used), (name, used)


def test_no_file_imports_itself_by_way_of_others():
    """Imports inside functions count, and those for types but of the lazy names in __init__.py."""
    with_types = {name: modules_named(path, types=path.name != "__init__.py") for name, path in FILES.items()}
    done, on_the_way = set(), []

    def visit(name: str) -> None:
        assert name not in on_the_way, " -> ".join([*on_the_way[on_the_way.index(name) :], name])
        if name not in done:
            on_the_way.append(name)
            for other in sorted(with_types[name]):
                visit(other)
            done.add(on_the_way.pop())

    for name in sorted(with_types):
        visit(name)


def test_plain_twins_are_for_tests_and_benches():
    for name, imported in imports().items():
        if not name.startswith("scene2spad.bench"):
            assert not {one for one in imported if one.endswith(".reference")}, name


@pytest.mark.parametrize("package", ARROWS)
def test_importing_a_package_starts_nothing(package):
    code = f"import sys, {package}; print([m for m in ('mitsuba', 'drjit', 'torch', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_the_wheel_holds_every_package():
    """Packages are listed by hand; one that is forgotten is missing from the wheel alone, where no other test looks."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert sorted(settings["tool"]["setuptools"]["packages"]) == sorted(
        {".".join(p.parent.relative_to(ROOT).parts) for p in FILES.values()}
    )
