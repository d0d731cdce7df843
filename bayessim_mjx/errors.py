"""Errors that are the user's to mend: the commands print them in one line, without a traceback."""


class UserError(ValueError):
    """Bad input. The message names the value, where it came from (file, flag, key) and what is allowed."""
