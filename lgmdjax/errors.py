"""The one exception for what a user can get wrong, so that the command line ends in a line and not in a traceback."""


class InputError(ValueError):
    """Bad input at the boundary: one line that says what was expected, what came, and what to do."""
