"""The verdicts of a diagnosis: the code that files and programs have, and the words that people read."""

from enum import StrEnum


class Verdict(StrEnum):
    """One of seven verdicts; it is a string, its code. `words` is its title in reports, on the terminal and in docs."""

    words: str

    def __new__(cls, code: str, words: str = "") -> "Verdict":
        """The member of a code."""
        member = str.__new__(cls, code)
        member._value_, member.words = code, words
        return member

    NO_GAP = "no_gap", "No gap"
    PARAMETERS = "parameters", "Parameters only"
    NOISE = "noise", "Noise larger than estimated"
    EFFECTS = "effects", "Missing effects found"
    AMBIGUOUS = "ambiguous", "Ambiguous"
    UNEXPLAINED = "unexplained", "Unexplained"
    INSUFFICIENT_DATA = "insufficient_data", "Too little data"
