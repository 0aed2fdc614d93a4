"""Rules of the house that a linter does not know: sizes, names, and how docstrings begin."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scenes", "render", "spad", "csph", "ultraphase", "scene2spad")
FILES = [path for one in PACKAGES for path in (ROOT / one).rglob("*.py")]
MAX_LINES, MAX_FUNCTION_LINES, MAX_PARAMETERS, MAX_MODULES = 400, 60, 7, 14
# What is larger still, at its size: it may shrink, not grow, and nothing may join it.
LARGER: dict[str, int] = {}
MORE_PARAMETERS: dict[str, int] = {}
MAX_ANY = (
    10  # in signatures; Dr.Jit's types and JSON objects have names of their own (`drjit_types`, `scenes.json_types`)
)
# Private words for which the field has terms.
NOT_OURS = {
    *("told", "said", "whys", "share", "shares", "tails", "watched", "thrown", "spelled", "least_share", "lit_points"),
    *(
        "can_die",
        "doubled",
        "trust",
        "of_pixels",
        "of_parts",
        "its_seed",
        "traced_on",
        "add_quanta",
        "begun_on_highlight",
    ),
}
CONSTANT = re.compile(r"(MOST|LEAST)_")
# First words of docstrings that are nouns, pronouns or another mood.
NO_IMPERATIVE = re.compile(
    r"(The|A|An|One|What|Whether|Where|How|All|Every|Both|Those|These|Its|Some|Two|Returns|Raises|Reads|Writes|Makes|Gives"
    r"|Mean|Depth|Radiance|Expected|Rows|Points|Counts|Codes|Numbers|Samples|InputError|Errors|Histograms|Measured"
    r"|Probability|Shape|Whole|Thin|Log-log|Multiply-accumulates|Centroid|Number|Median|Energy)\b"
)


@cache
def parsed() -> dict[Path, ast.Module]:
    """Parse every file once, and not before a test asks: both processes of the tests import this one."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}


def of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def functions() -> list[tuple[str, ast.FunctionDef]]:
    found = []
    for path, tree in parsed().items():
        found += [(f"{of(path)} {n.name}", n) for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    return found


def exceeding(sizes: dict[str, int], limit: int, known: dict[str, int]) -> dict[str, int]:
    return {name: size for name, size in sizes.items() if size > known.get(name, limit)}


def annotations(node: ast.FunctionDef) -> list[ast.expr]:
    args = node.args
    every = [*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg]
    return [one for one in (*(arg.annotation for arg in every if arg is not None), node.returns) if one is not None]


def test_sizes():
    assert len(FILES) > 250
    lines = {of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    assert not exceeding(lines, MAX_LINES, LARGER)
    lengths = {name: (node.end_lineno or 0) - node.lineno + 1 for name, node in functions()}
    assert not exceeding(lengths, MAX_FUNCTION_LINES, LARGER)
    folders: dict[str, int] = {}
    for path in FILES:
        if path.name != "__init__.py":
            folders[of(path.parent)] = folders.get(of(path.parent), 0) + 1
    assert not exceeding(folders, MAX_MODULES, LARGER)


def test_parameters():
    counts = {}
    for name, node in functions():
        args = node.args
        count = len(args.posonlyargs) + len(args.args) + len(args.kwonlyargs) + bool(args.vararg) + bool(args.kwarg)
        counts[name] = count - bool(args.args and args.args[0].arg in ("self", "cls"))
    assert not exceeding(counts, MAX_PARAMETERS, MORE_PARAMETERS)


def test_what_is_larger_is_still_there():
    """An exception that nothing needs any more goes."""
    names = {name for name, _ in functions()} | {of(path) for path in FILES} | {of(path.parent) for path in FILES}
    assert names >= LARGER.keys() | MORE_PARAMETERS.keys()


def test_any_in_signatures():
    found = [one for _, node in functions() for one in annotations(node) if re.search(r"\bAny\b", ast.unparse(one))]
    assert len(found) <= MAX_ANY


def test_names_are_the_fields():
    bad = []
    for path, tree in parsed().items():
        for node in ast.walk(tree):
            name = getattr(node, "id", None) or getattr(node, "attr", None) or getattr(node, "arg", None)
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                name = node.name
            if isinstance(name, str) and (name in NOT_OURS or CONSTANT.match(name)):
                bad.append(f"{of(path)}:{getattr(node, 'lineno', 0)} {name}")
    assert not bad


def public_functions(body: list[ast.stmt]) -> list[ast.FunctionDef]:
    found = []
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found += public_functions(node.body)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            found.append(node)
    return found


def test_docstrings_begin_with_an_imperative():
    """Of public functions; properties are nouns."""
    bad = []
    for path, tree in parsed().items():
        for node in public_functions(tree.body):
            text = ast.get_docstring(node)
            if text is None or any("property" in ast.unparse(one) for one in node.decorator_list):
                continue
            if NO_IMPERATIVE.match(text) or not text[0].isupper():
                bad.append(f"{of(path)}:{node.lineno} {node.name}: {text.splitlines()[0]}")
    assert not bad


@pytest.mark.parametrize("name", ["The mean of x.", "Returns x.", "x of y"])
def test_the_rule_of_docstrings_knows_what_is_none(name):
    assert NO_IMPERATIVE.match(name) or not name[0].isupper()


def private(name: str) -> bool:
    """Whether a name is private: of a named tuple and of notebooks some public ones begin with an underscore, too."""
    return name.startswith("_") and not name.startswith("__") and name not in {"_replace", "_repr_html_"}


def test_tests_use_public_names_only():
    """Imports and attributes; `self` may have its own."""
    bad = []
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [one.name for one in node.names] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names += (node.module or "").split(".")
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls", "os"):
                names.append(node.attr)
            bad += [f"{of(path)}:{node.lineno} {name}" for name in names if private(name)]
    assert not bad


def test_random_streams_have_numbers_of_their_own():
    """But for three that had been given away twice: files follow from them."""
    from scenes.random_streams import Stream

    twice = {name for name, member in Stream.__members__.items() if member.name != name}
    assert twice == {"VIEW", "ZONES", "COUPLED"}
    stages = [node for tree in parsed().values() for node in ast.walk(tree) if isinstance(node, ast.Name)]
    assert not [node.id for node in stages if node.id.startswith("STAGE_")]


def imported(tree: ast.Module) -> set[str]:
    """Dotted names of all that a module imports, wherever in it; of `from a import b` both a and a.b."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
    return names


def imports_between_folders(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Which folders each folder imports from; not what `__init__` gathers, nor of a folder and one that holds it.

    `trees` by the modules' dotted names, those of `__init__` too (`scenes.io.inputs`, `scenes.io.__init__`).
    """
    folders = {name: name.rpartition(".")[0] for name in trees}
    folders |= {folder: folder for folder in folders.values()}
    graph: dict[str, set[str]] = {}
    for name, tree in trees.items():
        if not name.endswith(".__init__"):
            here = folders[name]
            there = {folders[one] for one in imported(tree) if one in folders}
            apart = {one for one in there if not f"{one}.".startswith(f"{here}.") and not here.startswith(f"{one}.")}
            graph[here] = graph.get(here, set()) | apart
    return graph


def import_cycle(graph: dict[str, set[str]]) -> list[str]:
    """Folders that import each other round about, the first of them at the end again; empty where none do."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_folders_import_each_other_in_one_direction():
    graph = imports_between_folders(
        {of(path).removesuffix(".py").replace("/", "."): tree for path, tree in parsed().items()}
    )
    assert len(graph) > 30 and "scenes" in graph["render"]
    assert not import_cycle(graph)


def test_the_rule_of_directions_knows_a_cycle():
    """Also where an import stands in a function; a folder's own parts, and what `__init__` gathers, are none."""
    sources = {
        "p.__init__": "from p.a import one\nfrom p.b.two import two",
        "p.a.one": "from p import b\nimport p.top",
        "p.a.deep.three": "from p.a.one import one",
        "p.b.two": "import math",
        "p.top": "from p.a.one import one",
    }
    trees = {name: ast.parse(text) for name, text in sources.items()}
    assert imports_between_folders(trees) == {"p.a": {"p.b"}, "p.a.deep": set(), "p.b": set(), "p": set()}
    assert not import_cycle(imports_between_folders(trees))
    trees["p.b.two"] = ast.parse("def f():\n    from p.a.deep.three import three")
    assert not import_cycle(imports_between_folders(trees))  # p.a.deep imports p.a, which holds it
    trees["p.b.two"] = ast.parse("def f():\n    from p.a import one")
    assert {*import_cycle(imports_between_folders(trees))} == {"p.a", "p.b"}
