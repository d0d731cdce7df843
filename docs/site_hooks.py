"""What the site needs beyond docs/: pages that lie elsewhere, and links that also work on GitHub.

MkDocs calls these functions (mkdocs.yml). A page links to files of the repository by their relative path, as on
GitHub. On the site, those that are pages become links to them, and all others links into the repository.
"""

import importlib.util
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = ("CONTRIBUTING.md", "CHANGELOG.md", *(f"benchmarks/{p.name}" for p in (ROOT / "benchmarks").glob("*.md")))
PLOTLY = "pictures/plotly.min.js"  # the sample report asks for it; from the installed package, so that no copy is kept
NAMED = re.compile(r"\[([\w./-]+\.md)\](\(([^)\s#:]+\.md)(?:#[^)\s]*)?\))")  # a link that says its file's name
FRAME = '<iframe class="report" src="../pictures/report.html" title="report of a diagnosis"></iframe>'
LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the repository's top and of benchmarks/, and what the sample report draws with."""
    for name in ELSEWHERE:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    plotly = importlib.util.find_spec("plotly")
    assert plotly is not None and plotly.origin is not None, "the extra [docs] has plotly"
    script = Path(plotly.origin).parent / "package_data" / "plotly.min.js"
    files.append(File.generated(config, PLOTLY, abs_src_path=str(script)))
    return files


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
    parts = [part if k % 2 else NAMED.sub(titled, part) for k, part in enumerate(CODE.split(markdown))]
    return "".join(part if k % 2 else LINK.sub(site, part) for k, part in enumerate(parts))
