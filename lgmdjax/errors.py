"""The exception for invalid input, which the command line prints as one line without a traceback."""


class InputError(ValueError):
    """Invalid input from the user; the message is one line: what was expected, what was given, and what to do."""
