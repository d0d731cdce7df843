"""What the site needs beyond docs/: pages from elsewhere, tables made from the code, links that also work on GitHub.

MkDocs calls these functions (mkdocs.yml). A page links to files of the repository by their relative path, as on
GitHub. On the site, those that are pages become links to them, and all others links into the repository. The source is
read, not imported, so that the site needs no JAX.
"""

import ast
import importlib.util
import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = ("CONTRIBUTING.md", "CHANGELOG.md", *(f"benchmarks/{p.name}" for p in (ROOT / "benchmarks").glob("*.md")))
PLOTLY = "pictures/plotly.min.js"  # the sample report asks for it; from the installed package, so that no copy is kept
NAMED = re.compile(r"\[([\w./-]+\.md)\](\(([^)\s#:]+\.md)(?:#[^)\s]*)?\))")  # a link that says its file's name
FRAME = '<iframe class="report" src="../pictures/report.html" title="report of a diagnosis"></iframe>'
SETTINGS = ROOT / "bayessim_mjx" / "config" / "settings.py"
EFFECTS = ROOT / "bayessim_mjx" / "effects"
PARTS = ROOT / "tasks" / "_parts.py"
TABLE = re.compile(r"^<!-- table: ([\w.]+) -->$", re.MULTILINE)  # see `table`
SPECIAL = re.compile(r"[|*_]")  # what Markdown would take for its own
LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the repository's top and of benchmarks/, and what the sample report draws with."""
    from mkdocs.structure.files import File

    for name in ELSEWHERE:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    plotly = importlib.util.find_spec("plotly")
    assert plotly is not None and plotly.origin is not None, "the extra [docs] has plotly"
    script = Path(plotly.origin).parent / "package_data" / "plotly.min.js"
    files.append(File.generated(config, PLOTLY, abs_src_path=str(script)))
    return files


def table(name: str) -> str:
    """Write the Markdown table of a section of the settings, of all effects, or of the parts of walking robots."""
    if name == "effects":
        head = ["effect", "place", "law", "parameters"]
        rows = [row for file in sorted(EFFECTS.glob("*.py")) for row in _effects(file)]
    elif name == "locomotion":
        head, rows = ["in", "name", "value"], _parts()
    else:
        head, rows = ["key", "default", "meaning"], _settings(name)
    assert rows, f"<!-- table: {name} -->: there is no such table"
    cells = [[_escaped(cell) for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *cells])


def _escaped(cell: str) -> str:
    """Text as the cell of a Markdown table; code in it stays as it is but for the bar between cells."""
    parts = [p.replace("|", "\\|") if k % 2 else SPECIAL.sub(r"\\\g<0>", p) for k, p in enumerate(CODE.split(cell))]
    return "".join(p if k % 2 else p.replace("<", "&lt;") for k, p in enumerate(parts))


def _settings(section: str) -> list[list[str]]:
    """[key, default, meaning] of each setting of a section."""
    classes = [node for node in ast.parse(SETTINGS.read_text(encoding="utf-8")).body if isinstance(node, ast.ClassDef)]
    found = []
    for node in classes:
        own = {
            n.target.id: n.value for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
        }
        if _literal(own.get("SECTION")) == section:
            calls = {key: v for key, v in own.items() if isinstance(v, ast.Call) and len(v.args) == 2}
            found += [[f"`{k}`", f"`{ast.unparse(c.args[0])}`", str(_literal(c.args[1]))] for k, c in calls.items()]
    return found


def _effects(file: Path) -> list[list[str]]:
    """[name, kind of place, law, parameters] of the effects in a file."""
    found = []
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and "Effect" in map(ast.unparse, node.bases) and ast.get_docstring(node):
            own = {ast.unparse(n.target): n.value for n in node.body if isinstance(n, ast.AnnAssign)}
            calls = [n for n in ast.walk(node) if isinstance(n, ast.Call) and ast.unparse(n.func) == "Quantity"]
            units = [{k.arg: _literal(k.value) for k in call.keywords}.get("unit") for call in calls]
            named = [_literal(call.args[0]) or ast.unparse(call.args[0]).strip("f'\"") for call in calls]
            each = [f"{n} [{unit}]" if unit else str(n) for n, unit in zip(named, units, strict=True)]
            name, kind = (_literal(own.get(key)) or "" for key in ("name", "kind"))
            text = ast.get_docstring(node) or ""
            law = text.partition("\n\n")[0].replace("\n", " ").partition("; `friction")[0]
            stated = re.search(r"Parameters: (.*?)[.;]", text, re.DOTALL)  # where a function makes them
            words = ", ".join(each) or (stated[1].replace("\n", " ") if stated else "")
            found.append([f"`{name or file.stem}`", str(kind), law, words])
    return found


def _parts() -> list[list[str]]:
    """[observations or rewards, name, value] of the blocks and parts that walking robots have."""
    [owner] = [
        node for node in ast.parse(PARTS.read_text(encoding="utf-8")).body if getattr(node, "name", "") == "Parts"
    ]
    found = []
    for node in owner.body:
        kind, _, name = getattr(node, "name", "").partition("_")
        if isinstance(node, ast.FunctionDef) and kind in ("observe", "reward") and name:
            text = (ast.get_docstring(node) or "").partition("\n\n")[0].replace("\n", " ")
            found.append([{"observe": "observations", "reward": "rewards"}[kind], f"`{name}`", text])
    return found


def _literal(node: ast.expr | None) -> Any:
    try:
        return ast.literal_eval(node) if node is not None else None
    except ValueError:
        return None


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Relative links as the site needs them; code stays as it is."""
    source = page.file.src_uri
    folder = posixpath.dirname(source if source in ELSEWHERE else f"docs/{source}")  # in the repository

    def site(found: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(folder, found[2]))
        on_site = target if target in ELSEWHERE else target.removeprefix("docs/")
        if files.get_file_from_path(on_site) is not None and (target in ELSEWHERE or target.startswith("docs/")):
            return f"{found[1]}{posixpath.relpath(on_site, posixpath.dirname(source) or '.')}{found[3]}"
        if (ROOT / target).exists():
            kind = "tree" if (ROOT / target).is_dir() else "blob"
            return f"{found[1]}{config.repo_url.rstrip('/')}/{kind}/main/{target}{found[3]}"
        return found[0]  # MkDocs tells of it

    def titled(found: re.Match) -> str:
        file = ROOT / folder / found[3]
        return f"[{file.read_text(encoding='utf-8').partition('# ')[2].splitlines()[0]}]{found[2]}"

    markdown = markdown.replace("<!-- on the site the report stands here -->", FRAME)
    markdown = TABLE.sub(lambda found: table(found[1]), markdown)
    parts = [part if k % 2 else NAMED.sub(titled, part) for k, part in enumerate(CODE.split(markdown))]
    return "".join(part if k % 2 else LINK.sub(site, part) for k, part in enumerate(parts))
