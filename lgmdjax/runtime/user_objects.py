"""Objects of the user's own modules, named on the command line as `module:attribute`."""

from pkgutil import resolve_name
from typing import Any

from lgmdjax.errors import InputError


def find(name: str, expected: str) -> Any:
    """Return the object `module:attribute`, or the module for `module:`.

    >>> find("math:floor", "expected a function")(1.5)
    1

    Raises InputError, which begins with `expected`, if the name has no colon or the import fails.
    """
    if ":" not in name:
        raise InputError(f"{expected}, got {name}; choose one")
    try:
        return resolve_name(name)
    except Exception as error:  # also whatever the module does when it is imported
        reason = f"{type(error).__name__}: {error}"[:300]
        raise InputError(f"{expected}, got {name} ({reason}); is its folder on PYTHONPATH?") from error
