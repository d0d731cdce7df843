"""Writes benchmarks/results.md from benchmarks/records/*.json.

    python benchmarks/results.py [--check]

A record is one file: the section of the page it belongs to, the command and the machine that made its figures, and
`rows`, a claim each, or a `table` with `columns`, or both. The value or `n` of a row may name a cell of the table of
its record: `{single[alone]}` is the cell of the row "single" in the column "alone". So each figure is written once.

A row says where it is shown: in the first table of the page ("headline"), in the table of its section ("section"), or
in the record alone ("no"). A shown row has a `rank` in its table. A row says whether the goal is `met`. Where a value
is several figures and some meet the goal, the others have **no** beside them. A record with `shown_rows` and
`shown_columns` shows a part of its table in the section `shown_in`.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RECORD = ("section", "command", "machine")  # fields of every record
ROW = ("id", "claim", "goal", "value", "met", "interval", "n", "commit", "shown")  # of every row
TABLE = ("claim", "goal", "commit")  # of every record without rows
MET, SHOWN = ("yes", "no", "partly", ""), ("headline", "section", "no")
LIMIT = 12  # rows of a table of the page
HEADER = ("claim", "goal", "value", "interval", "n", "commit")

TITLE = """# Results

`python benchmarks/results.py` writes this page from [records](records): a row a claim, the latest count alone. The link
of the commit that made a figure leads to its command, machine and details, and to rows that this page leaves out. A
missed goal says **no**; a figure that meets its goal is bold. Intervals are 95 % unless a row says otherwise.
[how-to-run.md](how-to-run.md) explains the measures, [history.md](history.md) what did not work.
"""
# {section of the page: its text}; records name their section
SECTIONS = {
    "Posteriors and the loop": "*Gain*: log density of the truth over the prior, in nats. A loop has three rounds: "
    "train, log, infer.",
    "Tasks and training speed": "Compilation is counted apart. Where physics is nine tenths of an update, no trainer "
    "can be twice as fast as another one.",
    "Diagnosis of fresh cases": "Cases, rules and scorer were fixed before any case was diagnosed. Data sheets are 2 "
    "to 30 % off, by how much is not stated, and every effect is a candidate. "
    "[The leaderboard](../docs/leaderboard.md) compares methods.",
    "Fresh cases by robot and log": "*Alone*: the hidden effects are named, and nothing else. The last six rows have "
    "poor logs of all robots. *Known parameters* are of answers with exactly the hidden names.",
    "Real robots and corrections": "*sd*: the gap in standard deviations of the noise, before and after. Intervals of "
    "corrections are 90 %.",
    "Seconds and tests": "From the command to the report, on two cores, compilation included.",
}


def records(folder: Path = HERE / "records") -> dict[str, dict[str, Any]]:
    """{name: record}; strings of rows have the cells that they name."""
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    for record in found.values():
        cells = {row[0]: dict(zip(record["columns"], row, strict=True)) for row in record.get("table", ())}
        for row in record.get("rows", ()):
            row.update({key: row[key].format_map(cells) for key in ("value", "n")})
    return found


def faults(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What is wrong with the records: absent fields, unknown words, a claim twice, a table of the page too long."""
    out: list[str] = []
    claims: dict[str, str] = {}
    for name, record in found.items():
        fields = RECORD if "rows" in record else (*RECORD, *TABLE)
        out += [f"{name}: no {field}" for field in fields if field not in record]
        out += [f"{name}: its section is not one of the page"] * (record.get("section") not in SECTIONS)
        out += [f"{name}: neither rows nor table"] * (not {"rows", "table"} & set(record))
        for row in record.get("rows", ()):
            where = f"{name}.{row.get('id')}"
            out += [f"{where}: no {field}" for field in ROW if not isinstance(row.get(field), str)]
            out += [f"{where}: met or shown"] * (row.get("met") not in MET or row.get("shown") not in SHOWN)
            out += [f"{where}: no rank"] * (row.get("shown") != "no" and "rank" not in row)
            for claim in (where, row.get("claim", "")):
                first = claims.setdefault(claim, where)
                out += [f"{where}: {claim!r} twice, see {first}"] * (first is not where)
    for title, rows in {"headline": headline(found), **{s: section(found, s) for s in SECTIONS}}.items():
        out += [f"{title}: {len(rows)} rows"] * (len(rows) > LIMIT)
    return out


def headline(found: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Rows of the first table."""
    return _ranked(found, lambda record, row: row["shown"] == "headline")


def section(found: Mapping[str, Mapping[str, Any]], title: str) -> list[list[str]]:
    """Rows of the table of a section: of claims, or of the part of a record's table that is shown there."""
    out = _ranked(found, lambda record, row: row["shown"] == "section" and record["section"] == title)
    for record in found.values():
        if record.get("shown_in") == title:
            columns = [record["columns"].index(column) for column in record["shown_columns"]]
            out += [[row[k] for k in columns] for row in record["table"] if row[0] in record["shown_rows"]]
    return out


def _ranked(found: Mapping[str, Mapping[str, Any]], shown: Callable[..., bool]) -> list[list[str]]:
    rows = [(row.get("rank", 0), _cells(name, row)) for name, row in _rows(found) if shown(found[name], row)]
    return [cells for _, cells in sorted(rows)]


def _rows(found: Mapping[str, Mapping[str, Any]]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    return ((name, row) for name, record in found.items() for row in record.get("rows", ()))


def _cells(name: str, row: Mapping[str, Any]) -> list[str]:
    partly = "{}" if "**no**" in row["value"] else "{}, partly"
    value = {"yes": "**{}**", "no": "{}, **no**", "partly": partly, "": "{}"}.get(row["met"], "{}").format(row["value"])
    return [row["claim"], row["goal"], value, row["interval"], row["n"], f"[{row['commit']}](records/{name}.json)"]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """In Markdown."""
    lines = ["|" + "|".join(f" {cell} ".replace("  ", " ") for cell in cells) + "|\n" for cells in (header, *rows)]
    return "".join([lines[0], "|" + "---|" * len(header) + "\n", *lines[1:]])


def page(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The whole of results.md."""
    parts = [TITLE, table(HEADER, headline(found))]
    for title, text in SECTIONS.items():
        shown = next((r["shown_columns"] for r in found.values() if r.get("shown_in") == title), HEADER)
        parts += [f"## {title}\n", text + "\n", table(shown, section(found, title))]
    return "\n".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail if the page differs")
    check = parser.parse_args().check
    found, target = records(), HERE / "results.md"
    if wrong := faults(found):
        print(*wrong, sep="\n", file=sys.stderr)
        return 1
    if check:
        same = target.read_text(encoding="utf-8") == page(found)
        print("results.md is as the records say" if same else "results.md differs: run benchmarks/results.py")
        return 0 if same else 1
    target.write_text(page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
