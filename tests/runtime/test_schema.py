"""What a schema accepts, and how it names what it refuses."""

import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.runtime import schema
from lgmdjax.runtime.schema import Flag, Integer, Number, Numbers, Object, Text

EYES = Object({"width": Integer(1, 4096)}, {"overlap": Number(0.5, 1)})


@pytest.mark.parametrize(
    ("expected", "value"),
    [
        (Number(), 1),
        (Number(0, 1), 0.5),
        (Number(), np.float32(3)),
        (Integer(1, 3), 3),
        (Flag(), False),
        (Text(), ""),
        (Text(("a", "b")), "b"),
        (Numbers((2,), 0, 1), np.ones(2, np.float32)),
        (EYES, {"width": 80}),
        (EYES, {"width": 80, "overlap": 1, "more": None}),
    ],
)
def test_what_is_as_expected_is_accepted(expected: schema.Schema, value: object) -> None:
    schema.check(expected, value, "file", "make it again")


@pytest.mark.parametrize(
    ("expected", "value", "words"),
    [
        *(
            (Number(), value, "a finite number")
            for value in ("1", True, None, [1], float("nan"), float("inf"), 10**400)
        ),
        *((Integer(1, 3), value, "an integer of 1 to 3") for value in (0, 4, 1.0, "1", True, 7.5)),
        (Number(0), -1, "a finite number of 0 or more"),
        (Flag(), "yes", "true or false, got 'yes'"),
        (Flag(), 1, "true or false"),
        (Text(("a", "b")), "c", "one of a, b"),
        (Text(), 1, "expected text"),
        (Numbers((2,)), np.ones(3), "shape (2,), got float64 of shape (3,)"),
        (Numbers((2,)), np.ones(2, int), "got int64"),
        (Numbers((2,)), np.ones(2, np.float16), "got float16"),
        (Numbers((2,)), np.ones(2, bool), "got bool"),
        (Numbers((2,)), np.array([1, np.nan]), "finite floats"),
        (Numbers((2,), -1, 1), np.array([0, 1e38]), "0 to 1e+38"),
        (Numbers((2,)), [1.0, 1.0], "finite floats"),
        (EYES, {}, "file: expected an object with width, got an object with nothing"),
        (EYES, [], "an object with width, got []"),
        (EYES, {"width": 80, "overlap": 0.2}, "file.overlap: expected a finite number of 0.5 to 1, got 0.2"),
        (Object({"eyes": EYES}), {"eyes": {"width": 10**9}}, "file.eyes.width: expected an integer of 1 to 4096"),
    ],
)
def test_what_is_not_as_expected_is_named(expected: schema.Schema, value: object, words: str) -> None:
    with pytest.raises(InputError) as caught:
        schema.check(expected, value, "file", "make it again")
    message = str(caught.value)
    assert words in message and message.startswith("file") and message.endswith("; make it again")
    assert "\n" not in message


def test_control_characters_of_a_file_do_not_reach_the_terminal() -> None:
    with pytest.raises(InputError) as caught:
        schema.check(Flag(), "\x1b[2J\n", "file", "-")
    assert str(caught.value).isprintable()
