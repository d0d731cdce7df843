"""Run folders and the checkpoints in them."""

from bayessim_mjx.runs.folder import MANIFEST, Run, find_runs, latest_run, versions

__all__ = ["MANIFEST", "Run", "find_runs", "latest_run", "versions"]
