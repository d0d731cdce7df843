"""The printed list of settings has every key with its default and meaning, so that a checkout needs no site."""

import dataclasses
from typing import Any

from bayessim_mjx import main
from bayessim_mjx.config import PPOConfig, listing


def test_a_section_shows_every_key_with_default_and_meaning(capsys: Any) -> None:
    assert main.main(["help", "settings", "ppo"]) == 0
    out = capsys.readouterr().out
    told = [f for f in dataclasses.fields(PPOConfig) if "doc" in f.metadata]
    assert len(told) > 20
    for own in told:
        assert f"  ppo.{own.name} = " in out
    assert f"  ppo.gamma = {PPOConfig.gamma}\n" in out
    joined = " ".join(out.split())
    assert all(" ".join(str(own.metadata["doc"]).split()) in joined for own in told)


def test_all_of_them_have_the_sections_within_sections_too() -> None:
    text = listing.text()
    for name in ("env", "bayessim", "ppo", "ppo.rnd", "ppo.rnd.weight_schedule", "ppo.symmetry", "real", "monitor"):
        assert f"\n{name}:\n" in f"\n{text}"
    assert "run, without a section:" in text and "env.options = {}" in text and "\n  logdir = logs\n" in text
