"""Recorded motion: read (CSV, NPZ, foreign by a map), check, resample, cut into windows for replay."""

from bayessim_mjx.recordings.log import Channels, Log
from bayessim_mjx.recordings.mapping import LogMap
from bayessim_mjx.recordings.read import read_logs
from bayessim_mjx.recordings.resample import noise, resample, segments
from bayessim_mjx.recordings.signals import estimate_velocity
from bayessim_mjx.recordings.write import write_log

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
