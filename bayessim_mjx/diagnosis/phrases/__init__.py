"""The one room of words: every sentence that a diagnosis shows is made here, from numbers that others computed."""
