"""Typed configuration: re-exports the settings and loads them, strictly, from files, flags and overrides."""

from bayessim_mjx.settings import (
    BayesSimConfig,
    Config,
    EnvConfig,
    Frozen,
    MonitorConfig,
    PPOConfig,
    RealConfig,
    Section,
    freeze,
    thaw,
)

__all__ = [
    "BayesSimConfig", "Config", "EnvConfig", "Frozen", "MonitorConfig", "PPOConfig", "RealConfig", "Section", "freeze",
    "thaw",
]  # fmt: skip
