"""The exception for invalid input, which the command line prints as one line without a traceback."""


class InputError(ValueError):
    """Invalid input from the user: what was expected, what was given, and what to do.

    The message is made one printable line, since it may quote the content of a file.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))


def one_line(text: object) -> str:
    r"""Return a text as one line, with control characters escaped so that a terminal does not execute them.

    >>> one_line("a\n  b \x1b[2J")
    'a b \\x1b[2J'
    """
    words = " ".join(str(text).split())
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in words)
