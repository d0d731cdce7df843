"""What a diagnosis is doing, in words beside its progress; the search itself has short names."""

WORDS = {
    "screening": "trying every effect roughly",
    "more starting points": "trying every effect roughly, from more starting points",
    "single effects": "fitting one effect at a time",
    "screening again": "trying every further effect roughly",
    "sets of effects": "fitting several effects together",
    "final fits": "fitting the best explanations precisely",
    "leaving effects out": "fitting the best without each of their effects",
    "wider ranges": "trying wider ranges",
    "masked effects": "looking for effects that would not show",
    "size of the gap": "measuring the gap",
    "missing force": "looking for a missing force",
    "finer time steps": "repeating with finer time steps",
    "whole logs": "simulating whole logs",
    "place of the gap": "locating the gap",
    "network and formula": "comparing with a network and a formula",
    "next experiment": "choosing the next experiment",
}


def doing(stage: str) -> str:
    """Return a stage in words, with its round if it has one; others as they are."""
    name, comma, more = stage.partition(", ")
    return f"{WORDS.get(name, name)}{comma}{more}"
