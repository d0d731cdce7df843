"""Settings: their defaults and limits (settings.py), and how files, flags and overrides are read (loading.py)."""

from bayessim_mjx.config.layers import EFFECTS_SCHEMA, read_effects
from bayessim_mjx.config.loading import cfg_folder, from_dict, load, replace, task_file
from bayessim_mjx.config.settings import (
    BayesSimConfig,
    Config,
    EnvConfig,
    MonitorConfig,
    PPOConfig,
    RealConfig,
    RNDConfig,
    SymmetryConfig,
    WeightSchedule,
    freeze,
    refuse_together,
)
from bayessim_mjx.config.yaml_text import read_yaml, to_yaml
from bayessim_mjx.errors import unknown

__all__ = [
    "EFFECTS_SCHEMA", "BayesSimConfig", "Config", "EnvConfig", "MonitorConfig", "PPOConfig", "RNDConfig", "RealConfig",
    "SymmetryConfig", "WeightSchedule", "cfg_folder", "freeze", "from_dict", "load", "read_effects", "read_yaml",
    "refuse_together", "replace", "task_file", "to_yaml", "unknown",
]  # fmt: skip
