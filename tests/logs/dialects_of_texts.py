"""Planted faults of texts: encodings, delimiters, headers, and the marks in numbers."""

from __future__ import annotations

import numpy as np

from tests.logs.dialects import NAMES, PLAIN, TRUTH, Case, changed, comma, text

READR = "tidyverse/readr#749: decimal commas and semicolons of European spreadsheets"
SEMICOLONS = "asafdav/ng-csv#28: European Excel wants semicolons; sep= lines"
BYTES = "stackoverflow.com/questions/5552555: byte 0xe9 of Latin-1 read as UTF-8"
BOM = "johndcook.com/blog/2019/09/07: a byte order mark in the name of the first column"
PAGES = "donatstudios.com/CSV-An-Encoding-Nightmare: code pages of Excel"
MARKS = "elysiate.com/blog: number formatting in CSV, commas, decimals and locale chaos"
SAVETXT = "numpy/numpy: savetxt writes '# ' before the names, and fields of a fixed width"
HEADERS = "DavidMertz/DataCleaningSingapore: structural faults of delimited texts"

BIG = TRUTH * np.array([1, 1, 1e3, 1, 1])  # a command in thousandths, for groups of thousands
SMALL = {
    **NAMES,
    "time": "t",
    "delimiter": ";",
    "ctrl": {"m_shoulder": "ua", "m_elbow": {"column": "ub", "scale": 0.001}},
}
NEAR = 2e-6
SEMI = {**NAMES, "time": "t", "delimiter": ";"}
DEGREES = "t;ua;ub;qa [\u00b0];qb [\u00b0]"
IN_DEGREES = {**SEMI, "qpos": {"shoulder": {"column": "qa [\u00b0]", "unit": "deg"},
                              "elbow": {"column": "qb [\u00b0]", "unit": "deg"}}}  # fmt: skip
TABLE = TRUTH * np.array([1, 1, 1, *[180 / np.pi] * 2])
THREE = np.round(np.abs(TRUTH) + np.array([0, 1.5, 1.5, 1.5, 1.5]), 3)  # all fractions have three digits
THREE[:, 0] = 1.0 + 0.01 * np.arange(200)


def french(i: int, j: int, x: float) -> str:
    return f"{x:,.6f}".replace(",", "\u202f").replace(".", ",")


def german(i: int, j: int, x: float) -> str:
    return f"{x:,.6f}".replace(",", "_").replace(".", ",").replace("_", ".")


def mixed(i: int, j: int, x: float) -> str:
    return f"{x:.6f}".replace(".", ",") if j == 1 else f"{x:.6f}"


def ordinary(x: str) -> bytes:
    return x.encode()


LINES = text(TRUTH).splitlines()

CASES = [
    Case("utf-8 with a mark", BOM, text(TRUTH).encode("utf-8-sig")),
    Case("utf-16 with tabs", PAGES, text(TRUTH, PLAIN.replace(",", "\t"), "\t").encode("utf-16"),
         {**SEMI, "delimiter": "\t"}),
    Case("utf-16 without a mark", PAGES, text(TRUTH).encode("utf-16-le")),
    Case("utf-16, high byte first", PAGES, text(TRUTH).encode("utf-16-be")),
    Case("degree sign of Latin-1", BYTES, text(TABLE, DEGREES, ";").encode("latin-1"), IN_DEGREES, within=1e-6),
    Case("letters of Latin-1", BYTES, text(TRUTH, "t,ua,ub,position_\u00e9paule,qb").encode("latin-1"),
         {**NAMES, "time": "t", "qpos": {"shoulder": "position_\u00e9paule", "elbow": "qb"}},
         ("encoding: latin-1", "encoding: cp437"), True, {"encoding": "latin-1"}),
    Case("another encoding stated", PAGES, text(TRUTH).encode(), {"encoding": "utf-16"},
         ("not a text file in utf-16", "`encoding`"), True, {"encoding": "utf-8"}),
    Case("line ends of old Macintoshes", HEADERS, text(TRUTH, end="\r").encode()),
    Case("a line that names the delimiter", SEMICOLONS, b"sep=;\r\n" + text(TRUTH, PLAIN.replace(",", ";"),
         ";").encode(),
         {**NAMES, "time": "t"}),
    Case("semicolons", SEMICOLONS, text(TRUTH, PLAIN.replace(",", ";"), ";").encode(), {**NAMES, "time": "t"},
         ("semicolons", "delimiter: ';'"), True, {"delimiter": ";"}),
    Case("tabs", SEMICOLONS, text(TRUTH, PLAIN.replace(",", "\t"), "\t").encode(), {**NAMES, "time": "t"},
         ("tabs", r"delimiter: '\t'"), True, {"delimiter": "\t"}),
    Case("semicolons and a comma in a name", SEMICOLONS, text(TRUTH, "t;ua;ub;qa;qb, left", ";").encode(),
         {**NAMES, "time": "t", "qpos": {"shoulder": "qa", "elbow": "qb, left"}},
         ("delimiter: ';'",), True, {"delimiter": ";"}),
    Case("decimal commas", READR, text(TRUTH, PLAIN.replace(",", ";"), ";", comma).encode(), SEMI),
    Case("decimal commas, stated", READR, text(TRUTH, PLAIN.replace(",", ";"), ";", comma).encode(),
         {**SEMI, "decimal": ","}),
    Case("decimal commas between commas", READR, text(TRUTH, PLAIN, ",", comma).encode(), {**NAMES, "time": "t"},
         ("decimal marks too", "delimiter", "decimal"), True),
    Case("decimal commas in quotes", READR, text(TRUTH, form=lambda i, j, x: f'"{comma(i, j, x)}"').encode()),
    Case("three digits behind each comma", MARKS,
         text(THREE, PLAIN.replace(",", ";"), ";", lambda i, j, x: f"{x:.3f}".replace(".", ",")).encode(), SEMI,
         ("decimal: \",\"", "thousands: \",\""), True, {"decimal": ","}, truth=THREE),
    Case("three digits, as thousands", MARKS,
         text(THREE, PLAIN.replace(",", ";"), ";", lambda i, j, x: f"{x:.3f}".replace(".", ",")).encode(),
         {**SEMI, "thousands": ",", "time": {"column": "t", "scale": 0.001},
          "qpos": {j: {"column": c, "scale": 0.001} for j, c in (("shoulder", "qa"), ("elbow", "qb"))},
          "ctrl": {j: {"column": c, "scale": 0.001} for j, c in (("m_shoulder", "ua"), ("m_elbow", "ub"))}},
          truth=THREE),
    Case("English thousands", MARKS, text(BIG, PLAIN.replace(",", ";"), ";", lambda i, j, x: f"{x:,.6f}").encode(),
         SMALL),
    Case("German thousands", MARKS, text(BIG, PLAIN.replace(",", ";"), ";", german).encode(), SMALL),
    Case("French thousands", MARKS, text(BIG, PLAIN.replace(",", ";"), ";", french).encode(), SMALL,
         ("`decimal` and `thousands`",), True, {"decimal": ",", "thousands": " "}),
    Case("commas beside points", MARKS, text(TRUTH, PLAIN.replace(",", ";"), ";", mixed).encode(), SEMI,
         ("decimal: \".\"", "decimal: \",\""), True),
    Case("points against the map", MARKS, text(TRUTH, PLAIN.replace(",", ";"), ";").encode(), {**SEMI, "decimal": ","},
         ("decimal: ','", "thousands"), True, {"decimal": "."}),
    Case("exponents of Fortran", HEADERS, text(TRUTH, form=lambda i, j, x: f"{x:.8e}".replace("e", "D")).encode()),
    Case("the minus sign of typography", MARKS, text(TRUTH, form=lambda i, j, x: f"{x:.6f}".replace("-",
         "\u2212")).encode()),
    Case("a mark of programs in numbers", HEADERS, ordinary(changed(text(TRUTH), 5, "0.04,1_0,1,0,0")), None,
         ("'1_0' is not a number", "bad_rows"), True),
    Case("a line of units", HEADERS, ordinary("\n".join([LINES[0], "s,Nm,Nm,rad,rad", *LINES[1:]])), None,
         ("skip_after_header: 1",), True, {"skip_after_header": 1}),
    Case("lines before the header", HEADERS, ordinary("Recorder 3\nserial 17\n" + text(TRUTH)), None, ("skip_rows",),
         True,
         {"skip_rows": 2}),
    Case("no header", HEADERS, text(TRUTH, "").encode(),
         {"time": 0, "ctrl": {"m_shoulder": 1, "m_elbow": 2}, "qpos": {"shoulder": 3, "elbow": 4}},
         ("header: false",), True, {"header": False}),
    Case("a comma at the end of each line", HEADERS,
         ordinary("\n".join(line + "," for line in LINES) + "\n")),
    Case("a mark of comments before the names", SAVETXT, text(TRUTH, "# " + PLAIN.replace(",", " "), " ").encode(),
         {**SEMI, "delimiter": " "}),
    Case("columns set out by blanks", SAVETXT, text(TRUTH, "   ".join(PLAIN.split(",")), " ", "%12.6f").encode(),
         {**SEMI, "delimiter": " "}),
    Case("a name that comes twice", HEADERS, text(TRUTH, "t,u,u,qa,qb").encode(),
         {"time": 0, "ctrl": {"m_shoulder": 1, "m_elbow": 2}, "qpos": {"shoulder": 3, "elbow": 4}},
         ("header: false", "skip_rows: 1"), True, {"header": False, "skip_rows": 1}),
    Case("words for what is missing", HEADERS, ordinary(changed(text(TRUTH), 200, "1.99,#N/A,0,0,0")), None,
         ("'#n/a' is not a number", "bad_rows: drop"), True, {"bad_rows": "drop"}, truth=TRUTH[:199]),
    Case("a mark of thousands without a decimal mark", MARKS,
         text(BIG, PLAIN.replace(",", ";"), ";", lambda i, j, x: "1.234.567" if j == 2 else f"{x:.6f}").encode(), SMALL,
         ("'1.234.567' is not a number", "thousands"), True),
]  # fmt: skip
