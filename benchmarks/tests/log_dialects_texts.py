"""Faults of texts and of times: spreadsheets, loggers that died, several tables in one file, clocks and calendars."""

from datetime import datetime, timedelta

import numpy as np
from log_dialects import A, Fault, S, arm, csv, plain, put, text

EXCEL = "stackoverflow.com/questions/17953679: German Excel writes BOM, semicolons, decimal commas"
SWISS = "stackoverflow.com/questions/44664040: 1'234.5 of Swiss locales"
PANDAS = "stackoverflow.com/questions/36519086: the index becomes a column without a name"
LEVELS = "pandas-dev/pandas#22449: headers of two lines"
DEAD = "forum.arduino.cc: a card logger lost power: zeros or half a line at the end of the file"
RESTART = "stackoverflow.com/questions/55129577: the header stands again in the middle of an appended file"
FOOTER = "stackoverflow.com/questions/13651117: lines of sums at the end of a table"
MARKER = "tidyverse/readr#439: comments between rows"
FORMULA = "stackoverflow.com/questions/165042: Excel's apostrophes and formulas around numbers"
PREAMBLE = "pandas-dev/pandas#27461: keys and values above the table"
SYSTICK = "stm32 forum: counters of 24 bits run over every 168 ms"
SIGNED = "forum.arduino.cc: a signed counter becomes negative"
MIDNIGHT = "swift-nav/piksi_tools: seconds of the day begin again at midnight"
NMEA = "stackoverflow.com/questions/36254363: hhmmss.ss of NMEA taken for seconds"
SUMMER = "pandas-dev/pandas#7825: local times that come twice in October"
LEAP = "bugs.python.org/issue23574: second 60"
SERIAL = "stackoverflow.com/questions/57044407: Excel rounds what it shows"
BURST = "ros2/rclcpp#1455: messages arrive in bursts"
SPARSE = "facontidavide/PlotJuggler#354: each row holds one signal, the others are blank"
TIDY = "tidyverse/tidyr: long tables with a column of names"
LAKH = "stackoverflow.com/questions/10478857: groups of two digits in India"
SCIENCE = "stackoverflow.com/questions/27480049: 1.7E+18 for stamps in ns"
MATLAB = "mathworks.com/matlabcentral/answers/352544: numbers written as complex ones"
MIXED = "stackoverflow.com/questions/2490334: line ends of two kinds"
WORDS = "t,shoulder_torque_cmd,elbow_torque_cmd,shoulder_pos,elbow_pos"
ARM = {"ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": "ctrl:m_elbow"},
       "qpos": {"shoulder": "qpos:shoulder", "elbow": "qpos:elbow"}}  # fmt: skip
DEG = 180 / np.pi
LINES = plain(A).splitlines()


def stamped(make, table: np.ndarray = A) -> dict[str, bytes]:  # noqa: ANN001
    """Return the table with other texts in its column of times."""
    return csv(plain(table, form=lambda i, j, x: make(i) if j == 0 else f"{x:.9g}"))


def local(i: int, start: datetime, shift: float) -> str:
    """Return a stamp of the wall clock, which goes back by `shift` hours at row 100."""
    moment = start + timedelta(milliseconds=10 * i) - timedelta(hours=shift if i >= 100 else 0)
    return moment.strftime("%Y-%m-%d %H:%M:%S.%f")


def sparse() -> str:
    """Commands and positions in rows of their own, 5 ms apart."""
    rows = [f"{t:.6g},,,{q1:.9g},{q2:.9g}\n{t + 0.0002:.6g},{u1:.9g},{u2:.9g},,\n" for t, u1, u2, q1, q2 in A]
    return LINES[0] + "\n" + "".join(rows)


def german(i: int, j: int, x: float) -> str:
    return f"{x * (DEG if j > 2 else 1):.9g}".replace(".", ",")


COUNT24 = (2**24 - 3_000_000 + 160_000 * np.arange(200)) % 2**24
ODD = 0.01 * np.arange(200) + np.where(np.arange(200) % 5 == 0, 0, 0.01 * (-(np.arange(200) % 5)) + 0.0002
                                       * (np.arange(200) % 5))  # fmt: skip
TWO = np.concatenate([A[:100], put(A[100:], 0, A[100:, 0] - 1.0)])

FAULTS = [
    Fault("German Excel with units in the names", EXCEL, csv("\ufeff" + text(A, "Zeit [s];m_shoulder Soll [Nm];"
          "m_elbow Soll [Nm];shoulder Winkel [°];elbow Winkel [°]", ";", german)), ("unit: deg",)),
    Fault("German Excel in cp1252 with units in the names", EXCEL, csv(text(A, "Zeit [s];m_shoulder Soll [Nm];"
          "m_elbow Soll [Nm];shoulder Winkel [°];elbow Winkel [°]", ";", german), "cp1252"), ("unit: deg",)),
    Fault("Swiss thousands", SWISS, csv(text(put(A, 0, 10 * np.arange(200)), WORDS.replace("t,", "t_ms,", 1),
          form=lambda i, j, x: f"{x:,.0f}".replace(",", "'") if j == 0 else f"{x:.9g}")), ("thousands",),
          {"thousands": "'"}),
    Fault("groups of two digits", LAKH, csv(plain(A, form=lambda i, j, x: f'"12,34,{567 + i}.5"' if j == 1 else
          f"{x:.9g}")), ("not a number", "thousands"), "nothing"),
    Fault("an index without a name", PANDAS, csv(text(np.c_[np.arange(200), A], "," + WORDS))),
    Fault("an index by the name Unnamed: 0", PANDAS, csv(text(np.c_[np.arange(200), A], "Unnamed: 0," + WORDS))),
    Fault("names in two lines", LEVELS, csv("time,ctrl,ctrl,qpos,qpos\n,m_shoulder,m_elbow,shoulder,elbow\n"
          + text(A, "")), ("header: false",), {"header": False, "skip_rows": 2, "time": 0, "ctrl": {"m_shoulder": 1,
          "m_elbow": 2}, "qpos": {"shoulder": 3, "elbow": 4}}),
    Fault("names as tuples", LEVELS, csv(text(A, 'time,"(\'ctrl\', \'m_shoulder\')","(\'ctrl\', \'m_elbow\')",'
          '"(\'qpos\', \'shoulder\')","(\'qpos\', \'elbow\')"')), ("map",), {"ctrl": {"m_shoulder":
          "('ctrl', 'm_shoulder')", "m_elbow": "('ctrl', 'm_elbow')"}, "qpos": {"shoulder": "('qpos', 'shoulder')",
          "elbow": "('qpos', 'elbow')"}}),
    Fault("zeros at the end of the file", DEAD, {"run.csv": plain(A).encode() + bytes(512)},
          ("bad_rows",), {"bad_rows": "drop"}),
    Fault("half a line at the end", DEAD, csv(plain(A) + "2.0,0.31,-0."), ("bad_rows",), {"bad_rows": "drop"}),
    Fault("a last line that ends in its last field", DEAD, csv(plain(A) + "2.0,0.31,0.2,0.3,-"), ("bad_rows",),
          {"bad_rows": "drop"}),
    Fault("names again in the middle", RESTART, csv("\n".join([*LINES[:101], LINES[0], *LINES[101:]]) + "\n"),
          ("bad_rows",), {"bad_rows": "drop"}),
    Fault("names again, and the clock too", RESTART, csv("\n".join([*plain(TWO).splitlines()[:101], LINES[0],
          *plain(TWO).splitlines()[101:]]) + "\n"), ("cut the file", "begins anew"), lambda folder: [
          (folder / f"run{k}.csv").write_text(plain(TWO[100 * k:][:100])) for k in (0, 1)], truth=TWO, pieces=True),
    Fault("sums at the end", FOOTER, csv(plain(A) + "mean,0.3,0.1,0.2,-0.1\nmax,2,0.9,0.9,0.4\n"), ("bad_rows",),
          {"bad_rows": "drop"}),
    Fault("a sentence at the end", FOOTER, csv(plain(A) + "\nEnd of recording\n"), ("bad_rows",),
          {"bad_rows": "drop"}),
    Fault("comments between rows", MARKER, csv("\n".join([*LINES[:50], "# marker: start", *LINES[50:]]) + "\n"),
          ("bad_rows",), {"bad_rows": "drop"}),
    Fault("apostrophes before numbers", FORMULA, csv(plain(A, form=lambda i, j, x: f"'{x:.9g}")), ("not a number",),
          "nothing"),
    Fault("formulas around numbers", FORMULA, csv(plain(A, form=lambda i, j, x: f'"=""{x:.9g}"""')),
          ("not a number",), "nothing"),
    Fault("keys and values above the table", PREAMBLE, csv("\"Device\",\"RobotLogger 2\"\n\"Date\",\"04/03/2026\"\n"
          "\"Sample rate\",\"100\"\n\n" + text(A, WORDS) ), ("skip_rows",)),
    Fault("keys and values above, units below the names", PREAMBLE, csv("Device;RobotLogger 2\nOperator;M. Maier\n\n"
          + text(A, WORDS.replace(",", ";") + "\ns;Nm;Nm;rad;rad", ";"))),
    Fault("line ends of two kinds", MIXED, csv("".join(line + ("\r\n" if i % 3 else "\n") for i, line in
          enumerate(LINES)))),
    Fault("complex numbers of MATLAB", MATLAB, csv(plain(A, form=lambda i, j, x: f"{x:.9g}+0i")), ("suffix",), {
          "time": {"column": "time", "suffix": "+0i"}, "ctrl": {n: {"column": f"ctrl:{n}", "suffix": "+0i"} for n in
          ("m_shoulder", "m_elbow")}, "qpos": {n: {"column": f"qpos:{n}", "suffix": "+0i"} for n in ("shoulder",
          "elbow")}}),
    Fault("a counter of 24 bits at 16 MHz", SYSTICK, stamped(lambda i: str(COUNT24[i])), ("wrap: 16777216",),
          {"time": {"column": "time", "scale": 6.25e-8, "wrap": 16777216}}),
    Fault("a signed counter of us", SIGNED, stamped(lambda i: str((2**31 - 500_000 + 10_000 * i + 2**31) % 2**32
          - 2**31)), ("wrap: 4294967296",), {"time": {"column": "time", "unit": "us", "wrap": 4294967296}}),
    Fault("a counter of us at 2 kHz whose wrap is not stated", SIGNED, stamped(lambda i: str((2**32 - 5000 + 500 * i)
          % 2**32), put(arm(200), 0, 5e-4 * np.arange(200))), ("wrap: 4294967296",), {"time": {"column": "time",
          "unit": "us", "wrap": 4294967296}}, truth=put(A, 0, 5e-4 * np.arange(200))),
    Fault("seconds of the day past midnight", MIDNIGHT, stamped(lambda i: f"{(86399.0 + 0.01 * i) % 86400:.2f}"),
          ("wrap: 86400",), {"time": {"column": "time", "wrap": 86400}}),
    Fault("seconds of the GPS week past its end", MIDNIGHT, stamped(lambda i: f"{(604799.5 + 0.01 * i) % 604800:.2f}"),
          ("wrap: 604800",), {"time": {"column": "time", "wrap": 604800}}),
    Fault("hhmmss.ss of NMEA", NMEA, stamped(lambda i: (datetime(2026, 3, 4, 10, 15, 59) + timedelta(
          milliseconds=10 * i)).strftime("%H%M%S.%f")[:9]), ("format",),
          {"time": {"column": "time", "format": "%H%M%S.%f"}}),
    Fault("wall clock in October", SUMMER, stamped(lambda i: local(i, datetime(2026, 10, 25, 2, 59, 59), 1)),
          ("begins anew", "cut the file"), lambda folder: [(folder / f"run{k}.csv").write_text(plain(A[100 * k:][:100]))
          for k in (0, 1)], pieces=True),
    Fault("wall clock in March", SUMMER, stamped(lambda i: local(i, datetime(2026, 3, 29, 1, 59, 59), -1)),
          ("gap",), pieces=True),
    Fault("October with its zones", SUMMER, stamped(lambda i: local(i, datetime(2026, 10, 25, 2, 59, 59), 1)
          + ("+02:00" if i < 100 else "+01:00"))),
    Fault("second 60", LEAP, stamped(lambda i: f"2016-12-31T23:59:{59 + i // 100:02d}.{i % 100:02d}Z" if i < 200 else
          ""), ("bad_rows", "format", "not a time"), {"bad_rows": "drop"}, truth=A[:100]),
    Fault("days with five digits", SERIAL, stamped(lambda i: f"{46085.42711 + 0.01 * i / 86400:.5f}"), ("rate",),
          {"time": {"column": "time", "unit": "days", "rate": 100}}, within=2e-5),
    Fault("ns in seven digits", SCIENCE, stamped(lambda i: f"{1.7726193e18 + 1e7 * i:.6e}"), ("rate",),
          {"time": None, "rate": 100}),
    Fault("rows in bursts of five", BURST, csv(plain(put(S, 0, ODD), "servo")), ("rate",), {"time": {"column": "time",
          "rate": 100}}, "servo", S, 0.05),
    Fault("commands and positions in rows of their own", SPARSE, csv(sparse()), ("hold",), None,
          truth=A[1:], within=2e-3),
    Fault("a long table", TIDY, csv("time,name,value\n" + "".join(f"{row[0]:.6g},{n},{x:.9g}\n" for row in A for n, x in
          zip(LINES[0].split(",")[1:], row[1:], strict=True))), ("one column per channel", "name"), "nothing"),
]  # fmt: skip
