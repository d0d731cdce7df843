"""The parts of `bayessim_mjx.logs`: one file per step from a file on disk to windows for replay. Import from there."""
