"""The page says everything that is in the diagnosis, shows hostile strings as text and loads nothing."""

import dataclasses
import json
from html.parser import HTMLParser

import pytest

from bayessim_mjx import report
from bayessim_mjx.diagnosis.phrases.advice import verdict_of
from bayessim_mjx.diagnosis.result import VERDICTS, load
from bayessim_mjx.report.look import TONES
from tests.report import fake

VOID = {
    "meta",
    "br",
    "hr",
    "img",
    "input",
    "link",
    "wbr",
    "line",
    "rect",
    "circle",
}  # and those of SVG that close themselves


class Page(HTMLParser):
    """Visible text, tags with attributes, JSON of the figures, and whether tags are balanced."""

    def __init__(self, source: str):
        super().__init__()
        self.tags, self.open, self.words, self.figures, self.scripts = [], [], [], [], 0
        self.feed(source)
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        if tag in VOID:
            return
        assert self.open and self.open[-1][0] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        tag, attributes = self.open[-1] if self.open else ("", {})
        if tag == "script" and attributes.get("type") == "application/json":
            self.figures.append(json.loads(data))
        elif tag == "script":
            self.scripts += 1
        elif tag != "style":
            self.words.append(data)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return report.write(fake.full(), tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def page(written):
    return Page(written.read_text(encoding="utf-8"))


def test_page_is_balanced_and_small_enough(written, page):
    assert not page.open
    assert written.name == "report.html" and written.stat().st_size < 6_000_000


def test_every_effect_its_numbers_and_all_warnings_are_there(page):
    assert "Coulomb friction at elbow" in page.text and "0.0312 ± 0.0021 N m" in page.text
    assert "Command delay at m_shoulder" in page.text and "21.3 ± 1.1 ms" in page.text
    for words in (
        "Missing effects found",
        "68 %",
        "61 % – 74 %",
        "91 %",
        "(closes 66 %, weight 9.0 %)",
        "no log moves the elbow slower than 0.2 rad/s",
    ):
        assert words in page.text
    for words in (
        *fake.full().warnings,
        *fake.full().sentences,
        "elbow, at reversals below 0.2 rad/s",
        "next_experiment.csv",
    ):
        assert words in page.text
    for name, value in fake.full().versions.items():
        assert name in page.text and value in page.text


def test_a_weight_among_rivals_is_told_only_where_there_are_rivals(page):
    assert page.text.count("relative score among rivals") == 1
    assert page.text.lower().count("probability") == page.text.count("no probability")


def test_hostile_names_stay_text(page):
    assert page.scripts == 2  # plotly.js and the page's own; nothing from a log's name
    assert "<script>alert('log')</script>" in page.text


def test_nothing_is_loaded(written, page):
    assert not [tag for tag, a in page.tags if tag in ("link", "img", "iframe", "object") or "src" in a]
    assert all(a["href"].startswith("#") for _, a in page.tags if "href" in a)
    style = written.read_text(encoding="utf-8").partition("<style>")[2].partition("</style>")[0]
    assert "url(" not in style and "@import" not in style


def test_figures_are_of_the_page_s_width_and_hold_the_data(page):
    assert len(page.figures) >= 3 + 1 + 3 + 3 + 9 + 1  # waterfalls, horizons, maps, frequency, overlays, episodes
    assert all(f["width"] <= 960 and f["data"] for f in page.figures)
    overlay = next(f for f in page.figures if "columns" in f)
    rows = fake.full().details["overlays"][0]
    assert [v for v in overlay["columns"]["m"] if v is not None] == pytest.approx(rows["measured"])
    assert overlay["columns"]["m"].count(None) == len(rows["starts"]) - 1  # windows are not joined


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_renders_without_details(verdict, tmp_path):
    page = Page(report.write(fake.bare(verdict), tmp_path).read_text(encoding="utf-8"))
    assert not page.open
    own = verdict_of(fake.bare(verdict))
    for words in (own.badge, own.headline, own.advice):
        assert words in page.text
    assert "nan" not in page.text.lower().split()


def test_a_saved_diagnosis_gives_the_same_page(tmp_path, page):
    fake.full().save(tmp_path)
    assert Page(report.write(load(tmp_path), tmp_path).read_text(encoding="utf-8")).text == page.text


@pytest.mark.parametrize("key", sorted(fake.details()))
def test_any_one_of_the_details_may_be_missing_or_alone(key, tmp_path):
    whole = fake.full()
    rest = {k: v for k, v in whole.details.items() if k != key}
    for details in (rest, {key: whole.details[key]}):
        source = report.write(dataclasses.replace(whole, details=details), tmp_path).read_text(encoding="utf-8")
        assert not Page(source).open


def test_many_logs_stay_within_the_size(tmp_path):
    whole = fake.full()
    row = whole.details["overlays"][0]
    long = (
        row | {k: row[k] * 20 for k in ("time", "measured", "nominal", "calibrated", "with_effects")} | {"starts": []}
    )
    many = [long | {"log": f"log_{k}", "joint": f"j{j}"} for k in range(30) for j in range(6)]
    path = report.write(dataclasses.replace(whole, details={"overlays": many}), tmp_path)
    assert path.stat().st_size < 6_000_000
    assert "more are in details.json" in path.read_text(encoding="utf-8")


def test_many_links_of_the_chain_become_a_table(tmp_path):
    whole = fake.full()
    links = [link | {"name": f"{link['name']} {j}"} for j in fake.JOINTS for link in whole.details["links"]]
    page = Page(
        report.write(dataclasses.replace(whole, details={"links": links}), tmp_path).read_text(encoding="utf-8")
    )
    assert not page.open and "effort → motion wrist" in page.text
    assert not [a for _, a in page.tags if a.get("class") == "chain"]


def test_what_was_seen_before_any_simulation_stands_with_the_chain(tmp_path):
    lines = ["the motors follow their commands", "first guess: extra payload at tool: mass 1.00 +- 0.01"]
    page = rendered(dataclasses.replace(fake.full(), details={"before_simulation": {"lines": lines}}), tmp_path)
    assert not page.open and all(line.replace("+-", "±") in page.text for line in lines)


def rendered(diagnosis, tmp_path):
    return Page(report.write(diagnosis, tmp_path).read_text(encoding="utf-8"))


def test_the_header_says_what_was_diagnosed_and_when(page):
    for words in ("arm", "6 logs in logs/2026-11", "48.0 s, 3 operating conditions", "2026-11-22 18:30"):
        assert words in page.text[:600]


def test_the_page_is_as_wide_as_the_screen(page):
    (viewport,) = [a["content"] for tag, a in page.tags if tag == "meta" and a.get("name") == "viewport"]
    assert viewport.startswith("width=device-width")
    assert all(f["least"] <= f["width"] for f in page.figures)
    tables = sum(tag == "table" for tag, _ in page.tags)
    assert tables == sum(a.get("class") == "scroll" for _, a in page.tags) > 5


def test_a_phone_shows_all_figures_whole_but_the_table_of_similarities(page):
    wide = [f for f in page.figures if f.get("narrow", f)["least"] > 332]
    assert [f["data"][0]["type"] for f in wide] == ["heatmap"]
    folded = [f["narrow"] for f in page.figures if "narrow" in f]
    assert len(folded) == 3 + 3 + 1  # maps, frequency, estimates
    for figure in folded:
        axes = {k: own["domain"] for k, own in figure["layout"].items() if k.startswith(("xaxis", "yaxis"))}
        assert all(own == [0, 1] for k, own in axes.items() if k.startswith("x"))
        spans = sorted(own for k, own in axes.items() if k.startswith("y"))
        assert all(a[1] < b[0] for a, b in zip(spans, spans[1:], strict=False))


def test_without_effects_nothing_is_drawn_with_them(tmp_path):
    told = dataclasses.replace(fake.full(), verdict="parameters", effects=[], sentences=[])
    page = rendered(told, tmp_path)
    assert "with effects" not in page.text and "with the named effects" not in page.text
    names = [t.get("name") for f in page.figures for t in f["data"]]
    assert "recalibrated" in names and not {"with effects", "named effects"} & set(names)
    assert "effects.yaml holds them" in page.text


def test_no_bar_is_longer_than_its_scale(tmp_path):
    """Recalibration may make held-out motion worse; a candidate may too."""
    whole = fake.full()
    worse = [h | {"calibrated": 1.7 * h["nominal"], "ci": {}} for h in whole.gap.horizons]
    gap = dataclasses.replace(whole.gap, calibrated=1.7 * whole.gap.nominal, horizons=worse)
    candidates = [*whole.candidates, whole.candidates[1] | {"gap_closed": -2.49}]
    page = rendered(dataclasses.replace(whole, gap=gap, candidates=candidates), tmp_path)
    stacked = [f for f in page.figures if f["layout"].get("barmode") == "stack"]
    assert len(stacked) == 1
    for k in range(len(worse)):
        assert sum(t["x"][k] for t in stacked[0]["data"]) <= 1.0 + 1e-9
    falls = [t for f in page.figures for t in f["data"] if t["type"] == "bar" and "base" in t]
    assert falls and max(b + y for t in falls for b, y in zip(t["base"], t["x"], strict=True)) <= 1.0 + 1e-9
    assert "249" not in page.text and "none, it is worse" in page.text


def test_nothing_is_called_not_reproducible_where_nothing_was_repeated(tmp_path):
    whole = fake.full()
    alone = [h | {"floor": "noise", "reducible_floor": 1.0} for h in whole.gap.horizons]
    gap = dataclasses.replace(whole.gap, reducible_floor=1.0, horizons=alone)
    page = rendered(dataclasses.replace(whole, gap=gap), tmp_path)
    names = {t.get("name") for f in page.figures for t in f["data"]}
    assert "differs between repeats" not in names and "not explained" in names
    assert "No commands were repeated" in page.text and "not reproducible" not in page.text


def test_what_is_left_beside_effects_is_partly_explained(tmp_path):
    whole = fake.full()
    rows = {n: r | {"beyond": n == "elbow"} for n, r in whole.gap.physical.items()}
    gap = dataclasses.replace(whole.gap, physical=rows, beyond=["elbow"])
    page = rendered(dataclasses.replace(whole, verdict="unexplained", gap=gap), tmp_path)
    assert "Partly explained" in page.text and "more than the tolerance remains" in page.text
    assert [a for tag, a in page.tags if tag == "tr" and a.get("class") == "beyond"]


def test_physical_units_come_first(page):
    # 0.041 rad are 2.3 deg; 14.2 noise sd stand below
    assert "2.3 deg14.2 sd" in page.text.replace(" 14.2", "14.2") and "range of motion" in page.text
    assert "21.4 noise sd; wrist 2.3 deg" in page.text  # of several joints the roughest beside the share


def test_the_first_screen_is_verdict_gap_command_and_warnings(tmp_path):
    """In this order, and nothing else is open."""
    about = {"model": "Pendulum", "data": ["logs"], "logs": 6}
    page = rendered(dataclasses.replace(fake.full(), about=about), tmp_path)
    (head,) = [s for s in fake.full().sentences if s.startswith("The simulator lacks")]
    order = [head, "gap as delivered", "21.4 noise sd", "gap after recalibration", "gap with the effects"]
    order += ["Next step", f"bayessim-mjx train --task Pendulum effects={tmp_path}/effects.yaml", "3 warnings"]
    order += [fake.full().warnings[1], "The verdict in detail", fake.full().sentences[1], "Size of the gap"]
    at = [page.text.index(" ".join(words.split())) for words in order]
    assert at == sorted(at)
    parts = [a for tag, a in page.tags if tag == "details" and a.get("class") == "section"]
    assert len(parts) > 8 and not any("open" in a for a in parts)


def test_many_warnings_are_folded(tmp_path):
    many = dataclasses.replace(fake.full(), warnings=[f"warning number {k}" for k in range(9)])
    (own,) = [a for tag, a in rendered(many, tmp_path).tags if a.get("id") == "warnings"]
    assert "open" not in own
    (few,) = [a for tag, a in rendered(fake.full(), tmp_path).tags if a.get("id") == "warnings"]
    assert "open" in few


def test_below_the_noise_nothing_is_called_unexplained(tmp_path):
    """A model that leaves less than the estimated noise has no bar for a rest."""
    alone = [h | {"floor": "noise", "reducible_floor": 0.85, "with_effects": 0.85} for h in fake.full().gap.horizons]
    gap = dataclasses.replace(fake.full().gap, with_effects=0.85, reducible_floor=0.85, horizons=alone)
    page = rendered(dataclasses.replace(fake.full(), gap=gap), tmp_path)
    falls = [f["layout"]["xaxis"]["ticktext"] for f in page.figures if "ticktext" in f["layout"].get("xaxis", {})]
    assert falls and not [ticks for ticks in falls if any("not explained" in t.replace("<br>", " ") for t in ticks)]
    assert "0.85 noise sd, within the noise" in page.text


def test_the_accuracy_of_the_models_numbers_stands_with_them(tmp_path):
    own = {"mass": {"median": 0.12, "low": 0.06, "high": 0.31, "parameters": 3}}
    page = rendered(dataclasses.replace(fake.full(), accuracy=own), tmp_path / "a")
    assert "inferred from the logs, as a share: mass 12 % (90 %: 6.0 % – 31 %)." in page.text
    assert "inferred from the logs, as a share" not in rendered(fake.full(), tmp_path / "b").text


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_verdict_has_the_colour_of_the_terminal(verdict, tmp_path):
    on_terminal, on_page = TONES[verdict]
    assert f"--tone: {on_page};" in report.write(fake.bare(verdict), tmp_path).read_text(encoding="utf-8")
    others = [page for terminal, page in TONES.values() if terminal == on_terminal]
    assert set(others) == {on_page}


def test_a_robot_of_one_joint_has_no_table_of_shares(tmp_path):
    """`hinge 100 % (100 % - 100 %)` says nothing."""
    whole = fake.full()
    page = rendered(dataclasses.replace(whole, where=whole.where[:1]), tmp_path)
    assert f"All of it is at {whole.where[0].channel}" in page.text and "share of the squared gap" not in page.text


@pytest.mark.parametrize(("own", "said"), [("implicitfast", True), ("RK4", False)])
def test_the_page_has_the_time_step_of_the_errors_and_what_was_stated(own, said, tmp_path):
    """A model with another integrator has another error than the one that is reported."""
    about = {"timestep": 5e-4, "integrator": "RK4", "stated": {"accuracy": ["5%"]}}
    whole = fake.full()
    step = whole.gap.integrator | {"timestep": 5e-4, "substep": 5e-4, "integrator": "RK4", "delivered": own}
    gap = dataclasses.replace(whole.gap, integrator=step)
    text = rendered(dataclasses.replace(whole, about=about, gap=gap), tmp_path).text
    assert "Errors at time steps of 0.5" in text and "(RK4)" in text and "--accuracy 5%" in text
    assert ("in place of the model's 0.5 ms (implicitfast)" in text) == said
