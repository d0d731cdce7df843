"""The house rules that can be counted: short files and functions, and no circle of imports between files.

Imports inside functions and under TYPE_CHECKING count too, and so does `import_module` of a name that is written out.
Exceptions are listed to be mended, not to be added to.
"""

import ast
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_ERROR, EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[1]
FILE, FUNCTION = 400, 60  # lines at most
TREES = ("bayessim_mjx", "tasks", "examples", "benchmarks", "docs", "tests")
SETTINGS = "bayessim_mjx/config/settings.py"  # a list of settings, as long as there are settings

LONG_FILES = ("tests/report/fake.py",)
LONG_FUNCTIONS = (
    "tests/report/fake.py:details",
    "tests/report/fake.py:full",
)
CIRCLES: tuple[set[str], ...] = ()
# Imports by a name that is put together when the program runs: no test sees where they point.
DYNAMIC = {
    "bayessim_mjx/__init__.py": ["bayessim_mjx."],  # the public names, each imported when it is first used
    "bayessim_mjx/diagnosis/__init__.py": ["bayessim_mjx.diagnosis."],  # likewise
    "bayessim_mjx/effects/__init__.py": ["{__name__}."],  # an effect's name is its file's
    "bayessim_mjx/logs/importers/needs.py": ["?"],  # readers of other libraries' files, where they are installed
    "bayessim_mjx/main.py": ["bayessim_mjx."],  # a command's name is its file's
    "bayessim_mjx/registry.py": ["bayessim_mjx.tasks."],  # a task's name is its file's
    "bayessim_mjx/wrappers/agents/__init__.py": ["bayessim_mjx.wrappers.agents."],  # an agent's name is its file's
}
# Imports by a name that is written out, where a statement would not do.
WRITTEN_OUT = {
    "bayessim_mjx/__init__.py": ["bayessim_mjx.diagnose", "bayessim_mjx.versions"],  # when they are first asked for
}
# fold_in(key, i) is a member of split(key, n), so elsewhere a purpose of its own takes its key from keys.branch.
FOLDED = {
    "bayessim_mjx/keys.py": 1,
    "bayessim_mjx/distributions/box.py": 1,  # of a key that nothing splits
    "bayessim_mjx/inference/mdn.py": 1,  # of a key that nothing splits
}


@functools.cache
def sources(root: Path, trees: tuple[str, ...]) -> Mapping[str, str]:
    """{path: text} of the Python files below `root`."""
    files = (file for tree in trees for file in sorted((root / tree).rglob("*.py")))
    return {file.relative_to(root).as_posix(): file.read_text(encoding="utf-8") for file in files}


def long_files(texts: Mapping[str, str]) -> dict[str, int]:
    lines = {path: text.count("\n") for path, text in texts.items()}
    return {path: n for path, n in lines.items() if n > FILE}


def long_functions(texts: Mapping[str, str]) -> dict[str, int]:
    """{"path:name": lines}; decorators do not count."""
    found: dict[str, int] = {}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                name = f"{path}:{node.name}"  # of several the longest
                found[name] = max(lines, found.get(name, 0))
    return {name: n for name, n in found.items() if n > FUNCTION}


def imports(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """{module: modules among `texts` that it names in an import}, wherever in the file the import stands."""
    names = {path: path.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for path in texts}
    known = set(names.values())

    def named(path: str) -> Iterator[str]:
        package = names[path].split(".") if path.endswith("__init__.py") else names[path].split(".")[:-1]
        for node in ast.walk(ast.parse(texts[path])):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                above = package[: len(package) - node.level + 1] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                inner = (f"{base}.{alias.name}" for alias in node.names)
                yield from (module if module in known else base for module in inner)

        yield from (name for name in dynamic(texts[path]) if name in known)

    return {names[path]: set(named(path)) & known - {names[path]} for path in texts}


def dynamic(text: str) -> list[str]:
    """What `import_module` and `__import__` are called with, under whatever names they are imported.

    A name that is written out is given whole, of one put together its constant beginning, and "?" where it has none.
    """
    tree = ast.parse(text)
    aliases = (alias for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names)
    names = {"import_module", "__import__"}
    names |= {alias.asname for alias in aliases if alias.name in names and alias.asname}
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return [_beginning(call) for call in calls if ast.unparse(call.func).split(".")[-1] in names]


def _beginning(call: ast.Call) -> str:
    first: ast.expr = call.args[0] if call.args else call
    while isinstance(first, ast.BinOp):  # "a" + b, "a%s" % b
        first = first.left
    parts = first.values if isinstance(first, ast.JoinedStr) else [first]
    found = ""
    for part in parts:
        if isinstance(part, ast.Constant):
            found += str(part.value)
        elif isinstance(part, ast.FormattedValue) and ast.unparse(part.value) == "__name__":
            found += "{__name__}"
        else:
            break
    return found or "?"


def unknown(name: str) -> bool:
    """Whether a dynamic import of this name may be of the package itself."""
    return name == "?" or name.startswith(("bayessim_mjx", "{__name__}", "."))


def folded(texts: Mapping[str, str]) -> dict[str, int]:
    """{path: how often `jax.random.fold_in` is named in its code}, under whatever name it is imported."""
    found: dict[str, int] = {}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)):
            named = isinstance(node, ast.Attribute) and node.attr == "fold_in"
            named |= isinstance(node, ast.alias) and node.name.endswith("fold_in")
            named |= isinstance(node, ast.Constant) and node.value == "fold_in"
            if named:
                found[path] = found.get(path, 0) + 1
    return found


def circles(graph: Mapping[str, set[str]]) -> set[frozenset[str]]:
    """Groups of modules that reach each other (Tarjan's strongly connected components of two or more)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: set[frozenset[str]] = set()

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in graph[module]:
            if other not in index:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == index[module]:
            group = frozenset(stack[stack.index(module) :])
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.add(group)

    for module in graph:
        if module not in index:
            visit(module)
    return found


def test_files_are_short() -> None:
    assert {p: n for p, n in long_files(sources(ROOT, TREES)).items() if p not in {SETTINGS, *LONG_FILES}} == {}


def test_functions_are_short() -> None:
    assert {f: n for f, n in long_functions(sources(ROOT, TREES)).items() if f not in LONG_FUNCTIONS} == {}


def test_keys_for_a_purpose_of_its_own_are_those_that_no_split_gives() -> None:
    assert folded(sources(ROOT, ("bayessim_mjx", "tasks", "examples"))) == FOLDED


@pytest.mark.parametrize(
    "use",
    [
        "import jax\njax.random.fold_in(key, 1)\n",
        "from jax import random\nnew = random.fold_in\n",
        "from jax.random import fold_in as other\n",
        "import jax\ngetattr(jax.random, 'fold_in')(key, 1)\n",
    ],
)
def test_a_folded_key_is_found_however_it_is_named(use: str) -> None:
    assert folded({"a.py": use, "b.py": '"""As fold_in does."""\n# fold_in\n'}) == {"a.py": 1}


def test_no_circle_of_imports() -> None:
    found = circles(imports(sources(ROOT, ("bayessim_mjx",))))
    assert [sorted(circle) for circle in found if not any(circle <= known for known in CIRCLES)] == []


@pytest.mark.parametrize(
    "back",
    [
        "import room.a\n",
        "from room import a\n",
        "from . import a\n",
        "from .a import f\n",
        "def f():\n    import room.a\n",
        "import importlib\ndef f():\n    importlib.import_module('room.a')\n",
    ],
)
def test_a_circle_is_found_however_it_is_closed(back: str) -> None:
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from room.c import x\n"
    texts = {"room/__init__.py": "", "room/a.py": "import room.b\n", "room/b.py": typed, "room/c.py": back}
    assert circles(imports(texts)) == {frozenset({"room.a", "room.b", "room.c"})}
    assert circles(imports({**texts, "room/c.py": "import json\n"})) == set()


def test_imports_point_the_way_that_pyproject_states(tmp_path) -> None:
    assert lint_imports(str(ROOT / "pyproject.toml"), cache_dir=str(tmp_path)) == EXIT_STATUS_SUCCESS


def test_an_import_that_points_upwards_is_found(tmp_path) -> None:
    up = "type = forbidden\nsource_modules = bayessim_mjx.loop\nforbidden_modules = bayessim_mjx.physics\n"
    text = f"[importlinter]\nroot_package = bayessim_mjx\n[importlinter:contract:up]\nname = up\n{up}"
    (tmp_path / ".importlinter").write_text(text, encoding="utf-8")
    assert lint_imports(str(tmp_path / ".importlinter"), cache_dir=str(tmp_path)) == EXIT_STATUS_ERROR


def test_modules_of_the_package_are_imported_by_statements() -> None:
    found = {path: list(filter(unknown, dynamic(text))) for path, text in sources(ROOT, ("bayessim_mjx",)).items()}
    listed = {path: sorted(WRITTEN_OUT.get(path, []) + DYNAMIC.get(path, [])) for path in {*WRITTEN_OUT, *DYNAMIC}}
    assert {path: sorted(names) for path, names in found.items() if names} == listed


@pytest.mark.parametrize(
    ("use", "name"),
    [
        ("import importlib\nimportlib.import_module('bayessim_mjx.a')\n", "bayessim_mjx.a"),
        ("from importlib import import_module as load\nload('bayessim_mjx.a')\n", "bayessim_mjx.a"),
        ("def f(x):\n    __import__(f'bayessim_mjx.{x}')\n", "bayessim_mjx."),
        ("from importlib import import_module\nimport_module('bayessim_mjx.' + x)\n", "bayessim_mjx."),
        ("from importlib import import_module\nimport_module(f'{__name__}.{x}')\n", "{__name__}."),
        ("from importlib import import_module\nimport_module('.a', __package__)\n", ".a"),
        ("from importlib import import_module\nimport_module(name)\n", "?"),
    ],
)
def test_a_dynamic_import_is_found_however_it_is_written(use: str, name: str) -> None:
    assert dynamic(use) == [name] and unknown(name)
    assert not any(map(unknown, dynamic("import importlib\nimportlib.import_module(f'mujoco.{x}')\n")))


def test_long_ones_are_counted() -> None:
    body = "    x = 1\n" * FUNCTION
    texts = {
        "a.py": "@cached\ndef short():\n" + body[10:],
        "b.py": "class A:\n  def long():\n" + body,
        "c.py": "\n" * (FILE + 1),
    }
    assert long_functions(texts) == {"b.py:long": FUNCTION + 1} and long_files(texts) == {"c.py": FILE + 1}
