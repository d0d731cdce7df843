"""What a reader pays for, counted: returns to files that were left, and numbers without a source beside them.

A walk follows the calls of a function in the order of the text, each function once, as a reader would. A return is a
call into a file that the walk had left. The limits are the counts of today; they may fall and not rise.
"""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "bayessim_mjx"
# walk: (functions, files, returns) at most
WALKS = {
    ("diagnosis.run:diagnose", ("diagnosis",)): (362, 51, 41),
    ("loop.round_inference:infer", ("loop", "inference")): (108, 18, 14),
    ("loop.outer_loop:step", ("loop",)): (39, 7, 8),
}
# of constants and dataclass fields: (numbers, those without a source) at most
NUMBERS = {"diagnosis": (74, 0), "inference": (27, 0), "loop": (8, 0), "contract": (41, 0), "odometry": (22, 0)}
# a paper or its part, a measured rate or the page that has it, floating-point arithmetic, or an open admission
SOURCE = re.compile(
    r"results\.md|history\.md|records/|docs/|et al|\b(19|20)\d\d\b|\beq\.|\bsec\.|\bmeasured|\bcounted|\brecorded|"
    r"rules? of thumb|float(32|64)|rounding|\bsource:",
    re.I,
)
NEUTRAL = (0, 1, -1)  # no choice: a start, a sign, nothing

Place = tuple[str, str]  # (module, function or Class.method)


@functools.cache
def trees() -> dict[str, ast.Module]:
    files = sorted((ROOT / PACKAGE).rglob("*.py"))
    names = [f.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__") for f in files]
    return {name: ast.parse(file.read_text(encoding="utf-8")) for name, file in zip(names, files, strict=True)}


@functools.cache
def defined(module: str) -> dict[str, ast.AST]:
    """Functions, classes and methods of a module."""
    found: dict[str, ast.AST] = {}
    for node in trees()[module].body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{own.name}": own for own in node.body if isinstance(own, ast.FunctionDef)}
    return found


@functools.cache
def known(module: str) -> dict[str, tuple[str, str]]:
    """{name: (module, name there; "" for the module itself)} of imports and definitions."""
    found = {}
    for node in ast.walk(trees()[module]):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found[alias.asname or alias.name] = (whole, "") if whole in trees() else (node.module, alias.name)
    return found | {name: (module, name) for name in defined(module) if "." not in name}


def target(module: str, owner: str, node: ast.AST) -> Place | None:
    """The function that a name or attribute refers to; of a class its constructor."""
    if isinstance(node, ast.Name):
        there, name = known(module).get(node.id, ("", ""))
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        there, name = (module, owner) if node.value.id == "self" else known(module).get(node.value.id, ("", ""))
        name = f"{name}.{node.attr}".strip(".")
    else:
        return None
    if there not in trees() or not name:
        return None
    own = defined(there).get(name)
    name = f"{name}.__init__" if isinstance(own, ast.ClassDef) else name
    return (there, name) if name in defined(there) else None


def walk(start: Place, inside: tuple[str, ...]) -> tuple[int, int, int]:
    """(functions, files, returns) of a reader who follows every call within some folders of the package."""
    visited: dict[Place, None] = {}

    def visit(place: Place) -> None:
        module, name = place
        if place in visited or not module.startswith(tuple(f"{PACKAGE}.{folder}" for folder in inside)):
            return
        visited[place] = None
        owner = name.rpartition(".")[0]
        uses = [n for n in ast.walk(defined(module)[name]) if isinstance(n, ast.Name | ast.Attribute)]
        for node in sorted(uses, key=lambda n: (n.lineno, n.col_offset)):
            there = target(module, owner, node)
            if there is not None:
                visit(there)

    visit(start)
    order = [module for module, _ in visited]
    entered = [m for i, m in enumerate(order) if i == 0 or m != order[i - 1]]
    return len(visited), len(set(order)), len(entered) - len(set(order))


def numbers(text: str) -> Iterator[tuple[str, str]]:
    """(name, words beside it) of the numeric constants and dataclass fields of a file."""
    lines = text.splitlines()

    def beside(node: ast.stmt) -> str:
        first = node.lineno - 1
        while first and lines[first - 1].lstrip().startswith("#"):
            first -= 1
        return "\n".join(line.partition("#")[2] for line in lines[first : node.end_lineno])

    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and numeric(node.value):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield ast.unparse(target), beside(node)
        if isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            general, _, fields = (ast.get_docstring(node) or "").partition("Attributes:")
            for own in node.body:
                if isinstance(own, ast.AnnAssign) and numeric(own.value):
                    name = ast.unparse(own.target)
                    about = re.search(rf"\b{name}: (.*?)(?=\b\w+: |\Z)", fields, re.S)
                    yield f"{node.name}.{name}", "\n".join([beside(own), general, about[1] if about else ""])


def numeric(node: ast.expr | None) -> bool:
    """Whether a value is a number, or several, that somebody chose."""
    try:
        value = ast.literal_eval(node) if node is not None else None
    except ValueError:
        return False
    each = value if isinstance(value, tuple) else (value,)
    chosen = [isinstance(x, int | float) and not isinstance(x, bool) for x in each]
    return bool(each) and all(chosen) and not all(x in NEUTRAL for x in each)


@pytest.mark.parametrize("walked", WALKS, ids=lambda w: w[0])
def test_a_reader_returns_no_more_often_than_before(walked):
    (module, name), inside = walked[0].split(":"), walked[1]
    found = walk((f"{PACKAGE}.{module}", name), inside)
    assert all(now <= before for now, before in zip(found, WALKS[walked], strict=True)), found
    assert found[0] > 20  # the walk was not cut off at its start


@pytest.mark.parametrize("folder", NUMBERS)
def test_no_number_comes_without_a_source(folder):
    files = sorted((ROOT / PACKAGE / folder).rglob("*.py"))
    found = [(f"{f.name}:{name}", words) for f in files for name, words in numbers(f.read_text(encoding="utf-8"))]
    bare = [name for name, words in found if not SOURCE.search(words)]
    most, unsourced = NUMBERS[folder]
    assert len(found) <= most, len(found)
    assert len(bare) <= unsourced, bare


def test_what_is_counted_is_seen():
    text = '''
A = 3.0
B = 0  # neutral
C = (1.5, 2)  # Smith et al. 2001, eq. 3
D = True
E = "word"
@dataclass
class Limits:
    """Chosen freely.

    Attributes:
        far: measured on 20 cases; near: a guess.
    """

    far: float = 2.0
    near: float = 0.5
    start: int = 0
'''
    found = dict(numbers(text))
    assert list(found) == ["A", "C", "Limits.far", "Limits.near"]
    assert [name for name, words in found.items() if not SOURCE.search(words)] == ["A", "Limits.near"]
