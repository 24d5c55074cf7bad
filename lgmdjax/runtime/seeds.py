"""Seeds of random numbers. Imports no JAX, so that the command line can check a seed at once."""

from lgmdjax.errors import InputError

LIMIT = 2**32  # in single precision JAX keeps the last 32 bits of a seed: greater seeds would repeat smaller ones


def check(seed: int) -> None:
    """Raise `InputError` for a seed that is negative or too large.

    >>> check(-1)
    Traceback (most recent call last):
    ...
    lgmdjax.errors.InputError: expected a seed of 0 to 4294967295, got -1; choose another --seed
    """
    if not 0 <= seed < LIMIT:
        raise InputError(f"expected a seed of 0 to {LIMIT - 1}, got {seed}; choose another --seed")
