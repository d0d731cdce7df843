"""Recorded motion: read (CSV, NPZ, foreign by a map), check, resample, cut into windows for replay."""

from bayessim_mjx.logs.files import write_log
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.read import read_logs
from bayessim_mjx.logs.resample import noise, resample, segments
from bayessim_mjx.logs.signals import estimate_velocity

__all__ = [
    "Channels",
    "Log",
    "LogMap",
    "estimate_velocity",
    "noise",
    "read_logs",
    "resample",
    "segments",
    "write_log",
]
