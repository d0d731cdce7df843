"""Planted faults of times: units, epochs, dates, whole seconds, jitter and rows that come twice."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from tests.logs.dialects import HEADER, NAMES, TRUTH, Case, changed, dated, stamped, text, with_column

BAGPY = "jmscslgroup/bagpy#15: stamps are 1.6e9 in one export and 1.6e18 in another"
SECS = "jmscslgroup/bagpy#21: stamps are secs and nsecs in two columns"
WHOLE = "Minipada/ros2_data_collection#308: stamps cut to whole seconds"
LIES = "swift-nav/piksi_tools#629: the header says msec, the values are s"
MICRO = "cvg/px-ros-pkg#4: microseconds where nanoseconds were expected"
DAYFIRST = "pandas-dev/pandas#11725: German dates change to month first within a column"
SWAPPED = "pandas-dev/pandas#27454: day and month change places by their size"
STRICT = "pandas-dev/pandas#3341: dates that do not fit the stated order are swapped"
NAMED = "pandas-dev/pandas#55244: names of months"
SHEETS = "elysiate.com/blog: what a spreadsheet shows is no format of interchange"
JITTER = "unitreerobotics/unitree_sim_isaaclab#108: 5 to 20 ms of jitter"
TWICE = "DFKI-NI/mir_robot#114: messages sent twice with one stamp"
ORDER = "uzh-rpg/rpg_dvs_ros#57: stamps that run backwards"

K = np.arange(200)
RNG = np.random.default_rng(0)
LATE = np.sort(0.01 * K + RNG.uniform(0, 0.009, 200))
MOTION = np.stack(
    [LATE, np.sin(LATE), np.cos(LATE), 0.5 * np.sin(9 * LATE), 0.2 * np.cos(8 * LATE)], 1
)  # at the stamps
FAST = np.stack([0.01 * K, np.sin(0.01 * K), np.cos(0.01 * K), 0.5 * np.sin(0.09 * K), 0.2 * np.cos(0.08 * K)], 1)
MIDNIGHT = datetime(2026, 3, 4, 23, 59, 59)
TWO = ",".join(["date", "clock", *HEADER.split(",")[1:]])
NSEC = ",".join(["sec", "nsec", *HEADER.split(",")[1:]])


def in_unit(count: float, start: int = 0, name: str = "time") -> bytes:
    """Whole stamps, `count` of them a row."""
    return stamped(lambda i: str(start + round(count * i)), header=HEADER.replace("time", name)).encode()


def whole(i: int) -> str:
    return str(int(0.01 * i))


CASES = [
    Case("milliseconds", MICRO, in_unit(10), None, ("unit: ms",), True, {"time": {"column": "time", "unit": "ms"}}),
    Case("microseconds", MICRO, in_unit(1e4), None, ("unit: us",), True, {"time": {"column": "time", "unit": "us"}}),
    Case("nanoseconds", MICRO, in_unit(1e7), None, ("unit: ns",), True, {"time": {"column": "time", "unit": "ns"}}),
    Case("epoch in s", BAGPY, stamped(lambda i: f"{1772619302 + 0.01 * i:.2f}").encode(), within=1e-6),
    Case("epoch in ms", BAGPY, in_unit(10, 1772619302250), words=("ms since 1970",)),
    Case("epoch in us", BAGPY, in_unit(1e4, 1772619302250000), words=("us since 1970",)),
    Case("epoch in ns", BAGPY, in_unit(1e7, 1772619302250000000), words=("ns since 1970",)),
    Case("a name with a unit", LIES, in_unit(10, name="t_ms"), {"time": "t_ms"}, ("as its name says",)),
    Case("a name with a wrong unit", LIES, stamped(lambda i: f"{0.01 * i:.2f}", header=HEADER.replace("time",
         "tow(msec)"))
         .encode(), {"time": "tow(msec)"}, ("unit: ms", "unit: s"), True, {"time": {"column": "tow(msec)",
         "unit": "s"}}),
    Case("milliseconds at 1 kHz", MICRO, in_unit(1), None, ("unit: ms", "unit: s"), True,
         {"time": {"column": "time", "unit": "ms"}}, truth=with_column(0, 0.001 * K, TRUTH)),
    Case("days of a spreadsheet", SHEETS, stamped(lambda i: f"{46085.4270 + 0.01 * i / 86400:.12f}").encode(),
         words=("days of a spreadsheet",), within=1e-5),
    Case("dates with points", DAYFIRST, stamped(dated("%d.%m.%Y %H:%M:%S.%f")).encode()),
    Case("dates with points and commas", DAYFIRST, stamped(dated("%d.%m.%Y %H:%M:%S,%f"), sep=";",
         header=HEADER.replace(",", ";")).encode(), {"delimiter": ";"}),
    Case("day first, sure by its size", SWAPPED, stamped(dated("%d/%m/%Y %H:%M:%S.%f", datetime(2026, 11,
         29))).encode()),
    Case("month first, sure by its size", SWAPPED, stamped(dated("%m/%d/%Y %H:%M:%S.%f", datetime(2026, 11,
         29))).encode()),
    Case("day or month first, all the same", SWAPPED, stamped(dated("%d/%m/%Y %H:%M:%S.%f")).encode()),
    Case("day or month first, past midnight", SWAPPED, stamped(dated("%d/%m/%Y %H:%M:%S.%f", MIDNIGHT)).encode(), None,
         ("day first", "month first", "format"), True, {"time": {"column": "time", "format": "%d/%m/%Y %H:%M:%S.%f"}}),
    Case("dates against the stated form", STRICT, stamped(dated("%d/%m/%Y %H:%M:%S.%f", datetime(2026, 11,
         29))).encode(),
         {"time": {"column": "time", "format": "%m/%d/%Y %H:%M:%S.%f"}}, ("29/11/2026", "time: format"), True,
         {"time": {"column": "time", "format": "%d/%m/%Y %H:%M:%S.%f"}}),
    Case("dates that change their form", DAYFIRST, stamped(
         lambda i: dated("%d.%m.%Y %H:%M:%S.%f" if i < 99 else "%Y-%m-%d %H:%M:%S.%f")(i)).encode(), None,
         ("line 101", "not a time like those before it", "format"), True),
    Case("years first, with strokes", DAYFIRST, stamped(dated("%Y/%m/%d %H:%M:%S.%f")).encode()),
    Case("two digits of the year", SWAPPED, stamped(dated("%d/%m/%y %H:%M:%S.%f")).encode(), None,
         ("04/03/26", "`format`"), True, {"time": {"column": "time", "format": "%d/%m/%y %H:%M:%S.%f"}}),
    Case("names of months", NAMED, stamped(dated("%d-%b-%Y %H:%M:%S.%f")).encode()),
    Case("half days, past noon", SHEETS, stamped(dated("%m/%d/%Y %I:%M:%S.%f %p", datetime(2026, 11, 29, 11, 59, 59)))
         .encode()),
    Case("times of day, past midnight", SHEETS, stamped(dated("%H:%M:%S.%f", MIDNIGHT)).encode()),
    Case("minutes and seconds, past the hour", SHEETS, stamped(dated("%M:%S.%f", MIDNIGHT)).encode()),
    Case("two numbers of a clock", SHEETS, stamped(dated("%H:%M")).encode(), None,
         ("format: '%H:%M'", "format: '%M:%S'"), True),
    Case("ISO 8601 with a comma", SHEETS, stamped(dated("%Y-%m-%dT%H:%M:%S,%f"), sep=";", header=HEADER.replace(",",
         ";"))
         .encode(), {"delimiter": ";"}),
    Case("date and time in two columns", SHEETS, text(np.c_[K, TRUTH], TWO, form=lambda i, j, x: (
         dated("%d.%m.%Y", MIDNIGHT)(i) if j == 0 else dated("%H:%M:%S.%f", MIDNIGHT)(i) if j == 1 else f"{x:.6f}"))
         .encode(), {"time": {"column": "clock", "date": "date"}}),
    Case("seconds and nanoseconds", SECS, text(np.c_[K, TRUTH], NSEC, form=lambda i, j, x: (
         str(1772619302 + i // 100) if j == 0 else str(i % 100 * 10**7) if j == 1 else f"{x:.6f}")).encode(),
         {"time": {"column": "sec", "nanoseconds": "nsec"}}),
    Case("whole seconds", WHOLE, stamped(whole).encode(), None, ("about 199 rows per second", "rate:"), True,
         {"time": {"column": "time", "rate": 100}}),
    Case("dates in whole seconds", WHOLE, stamped(dated("%Y-%m-%d %H:%M:%S", datetime(2026, 3, 4))).encode(), None,
         ("rate:",), True, {"time": {"column": "time", "rate": 100}}),
    Case("whole seconds and a wrong rate", WHOLE, stamped(lambda i: str(int(0.02 * i))).encode(),
         {"time": {"column": "time", "rate": 200}}, ("rows per second", "rate: 200"), True,
         {"time": {"column": "time", "rate": 50}}, truth=with_column(0, 0.02 * K, TRUTH)),
    Case("late stamps of even rows", JITTER, text(with_column(0, LATE, FAST)).encode(),
         {"time": {"column": "time", "rate": 100}}, ("fits the rate better",), truth=with_column(0, LATE[0] + 0.01 * K,
         FAST)),
    Case("late stamps of even rows, no rate stated", JITTER, text(with_column(0, LATE, FAST)).encode(), None,
         ("fits an even rate", "rate: "), truth=with_column(0, LATE, FAST)),
    Case("uneven rows and a stated rate", JITTER, text(MOTION, form="%.9f").encode(),
         {"time": {"column": "time", "rate": 100}}, ("fits the stamps better",),
         truth=with_column(0, LATE[0] + 0.01 * K, MOTION)),
    Case("rows that come twice", TWICE, text(np.repeat(TRUTH, 1 + (K % 7 == 3), axis=0)).encode(),
         words=("repeat the row before",)),
    Case("one stamp and two values", TWICE, text(np.insert(TRUTH, 8, TRUTH[7] + [0, 0, 0, 0.1, 0], axis=0)).encode(),
         None,
         ("line 10", "bad_rows: drop"), True, {"bad_rows": "drop"}),
    Case("a stamp that runs back", ORDER, changed(text(TRUTH), 200, "0.5,0,0,0,0").encode(), None,
         ("line 201", "strictly increasing", "bad_rows: drop"), True, {"bad_rows": "drop"}, truth=TRUTH[:199]),
    Case("half days without AM and PM", SHEETS, stamped(dated("%I:%M:%S.%f", datetime(2026, 3, 4, 12, 59,
         59))).encode(),
         None, ("line 102", "begins anew", "cut the file"), True),
    Case("two recordings in one file", ORDER,
         text(with_column(0, np.r_[TRUTH[:100, 0], TRUTH[:100, 0]], TRUTH)).encode(), None,
         ("line 102", "begins anew", "cut the file"), True),
    Case("names of other channels", LIES, in_unit(10, name="t"), {**NAMES, "time": "t"}, ("no column 'ua'",), True),
]  # fmt: skip
