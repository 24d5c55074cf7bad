"""Text of files and paths on the page.

viser renders Markdown with the HTML in it, and its server reads the pictures that it names, from the disk or the
network. Names of folders, contents of headers and messages that quote them therefore have to be escaped.
"""

import re

from lgmdjax.errors import one_line

PUNCTUATION = re.compile(r"[!-/:-@\[-`{-~]")  # of ASCII, all of which a backslash escapes (CommonMark 0.31, sec. 2.4)


def bold(text: str) -> str:
    r"""Return Markdown that shows a text as it is, in bold.

    >>> bold("<b>")
    '**\\<b\\>**'
    """
    return f"**{PUNCTUATION.sub(_escape, one_line(text))}**"


def _escape(letter: re.Match[str]) -> str:
    return f"\\{letter[0]}"
