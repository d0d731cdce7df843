"""report.html: one self-contained page, plotly.js inside, nothing loaded from anywhere."""

import json
import os
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.report import evidence, sections
from bayessim_mjx.report.look import COLUMN, STAGE, TONES, WIDTH
from bayessim_mjx.report.words import STAGES, not_fitted, page

TEMPLATE = "template.html.j2"


def write(diagnosis: Diagnosis, folder: str | Path, missed: Any = None) -> Path:
    """Write `folder/report.html`; returns its path. `missed`: of a blind check, `sentences`, `cases` and its `page`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "report.html"
    link = Path(os.path.relpath(missed.page, folder.resolve())).as_posix() if missed else ""
    path.write_text(render(diagnosis, missed, link, folder), encoding="utf-8")
    return path


def render(d: Diagnosis, missed: Any = None, link: str = "", folder: Path = Path()) -> str:
    """Return the page as text; `link`: to the page of the blind check, from this one; `folder`: of the result."""
    from plotly.offline import get_plotlyjs

    return (
        environment()
        .get_template(TEMPLATE)
        .render(
            plotly=Markup(get_plotlyjs()),
            width=WIDTH,
            column=COLUMN,
            stage_names=STAGES,
            stage_colours=STAGE,
            verdict=d.verdict,
            tone=TONES[d.verdict][1],
            top=sections.top(d, folder),
            about=sections.about(d),
            gap=sections.how_far(d),
            effects=sections.effects(d),
            candidates=sections.candidates(d),
            not_fitted=not_fitted(d),
            where=sections.where(d),
            overlays=evidence.overlays(d),
            parameters=evidence.parameters(d),
            isolability=evidence.isolability(d),
            flexible=evidence.flexible(d),
            black_boxes=evidence.black_boxes(d),
            experiment=evidence.experiment(d),
            data=evidence.data(d),
            warnings=d.warnings,
            missed=missed,
            missed_link=quote(link) if link else missed and missed.page.as_uri(),
            versions=d.versions,
            simulated=sections.simulated(d),
        )
    )


def environment() -> Any:
    """Make the `jinja2.Environment` of the pages: templates of this folder, with what they share."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"embed": embed, "page": page}
    return made


def embed(value: Any) -> Markup:
    """JSON that may stand inside a <script> element, whatever strings are in it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
