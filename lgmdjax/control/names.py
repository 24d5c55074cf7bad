"""Names of the five policies and of the navigator's variants. Imports no JAX, so that the command line can use them."""

from typing import Literal, get_args

PolicyName = Literal["teacher", "learned", "blind", "direct", "random"]
"""Name of a policy (`lgmdjax.control.policies`) in commands, in files and in figures."""

POLICY_NAMES: tuple[PolicyName, ...] = get_args(PolicyName)
"""All names of policies, in the order of `policies.POLICIES`."""

Variant = Literal["lstm", "lstm-efference", "feed-forward", "mean"]
"""Name of a network of the navigator (`lgmdjax.control.navigator` has a table of them)."""

VARIANTS: tuple[Variant, ...] = get_args(Variant)
