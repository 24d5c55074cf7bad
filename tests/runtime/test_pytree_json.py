"""Structures of results survive JSON, and a document can name no code to run."""

import json
import sys
from enum import Enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct
from mujoco import mjx

from lgmdjax.body import hexapod
from lgmdjax.runtime import pytree_json

HERE = __name__.partition(".")[0]
PACKAGES = (HERE, "mujoco", "optax")


class Side(Enum):
    LEFT = 1
    RIGHT = 2


@struct.dataclass
class Tagged:
    """A pytree with static fields of all kinds."""

    number: jax.Array
    label: str = struct.field(pytree_node=False, default="a")
    sizes: tuple[int, ...] = struct.field(pytree_node=False, default=(1, 2))
    ratio: float = struct.field(pytree_node=False, default=0.1)
    side: Side = struct.field(pytree_node=False, default=Side.RIGHT)
    count: np.int64 = struct.field(pytree_node=False, default=np.int64(3))


class Pair(NamedTuple):
    first: object
    second: object


class Unregistered:
    """No pytree."""


KEY = jax.random.key(0)
TREES = [
    1.0,
    None,
    (),
    {"b": 1.0, "a": [2.0, (None, 3.0)]},
    Pair(1.0, Pair(None, {"x": 2.0})),
    {"key": KEY, "keys": jax.random.split(KEY)},
    Tagged(1.0),  # pyright: ignore[reportArgumentType]
    [Tagged(jnp.ones(2), label="b", sizes=(), ratio=float("inf"), side=Side.LEFT, count=np.int64(2**40))],
    Tagged(1.0, label=optax),  # pyright: ignore[reportArgumentType]
    optax.adam(1e-3).init({"w": jnp.ones(2)}),
]


@pytest.mark.parametrize("tree", TREES)
def test_a_structure_survives_json(tree):
    text = json.dumps(pytree_json.encode(tree, PACKAGES))
    read = pytree_json.decode(json.loads(text), PACKAGES)
    assert jax.tree.structure(read) == jax.tree.structure(tree)


def test_the_state_of_the_physics_survives_json():
    """It has static arrays, which MJX wraps."""
    data = jax.eval_shape(lambda: mjx.make_data(hexapod.build()))
    text = json.dumps(pytree_json.encode(data, PACKAGES))
    assert jax.tree.structure(pytree_json.decode(json.loads(text), PACKAGES)) == jax.tree.structure(data)


@pytest.mark.parametrize(
    "tree",
    [
        {1: 2.0},  # keys of JSON are strings
        Tagged(1.0, label=b"bytes"),  # pyright: ignore[reportArgumentType]
        Tagged(1.0, label=print),  # pyright: ignore[reportArgumentType]
        Tagged(1.0, label=np.array(["text"])),  # pyright: ignore[reportArgumentType]
        Tagged(1.0, label=json),  # pyright: ignore[reportArgumentType]
        Tagged(1.0, label=Unregistered()),  # pyright: ignore[reportArgumentType]
        jax.tree_util.Partial(print, 1.0),
    ],
)
def test_what_json_cannot_hold_is_refused(tree):
    with pytest.raises(ValueError, match="expected"):
        pytree_json.encode(tree, PACKAGES)


def test_a_local_class_is_refused():
    @struct.dataclass
    class Local:
        number: float

    with pytest.raises(ValueError, match="expected"):
        pytree_json.encode(Local(1.0), PACKAGES)


@pytest.mark.parametrize(
    "document",
    [
        {"dataclass": ["subprocess:Popen", {"args": "touch /tmp/x"}]},
        {"dataclass": [f"{__name__}:Unregistered", {}]},
        {"dataclass": [f"{__name__}:Tagged", {"number": {"leaf": None}}]},
        {"dataclass": [f"{__name__}:sys.exit", {}]},
        {"namedtuple": [f"{__name__}:NamedTuple", {}]},
        {"namedtuple": [f"{__name__}:pytest.fail", {"reason": "x"}]},
        {"namedtuple": [f"{__name__}:Pair", {"first": 1}]},
        {"enum": [f"{__name__}:Tagged", "label"]},
        {"enum": [f"{__name__}:Side", "__class__"]},
        {"module": "subprocess"},
        {"module": ["optax"]},
        {"array": ["O", [1], "0000000000000000"]},
        {"array": ["<i8", [2], "00"]},
        {"call": ["print", []]},
        {"leaf": None, "tuple": []},
        {"tuple": 3},
    ],
)
def test_a_hostile_document_can_only_fail(document):
    with pytest.raises(Exception, match=r".") as caught:
        pytree_json.decode(document, PACKAGES)
    assert isinstance(caught.value, (ValueError, TypeError, KeyError, AttributeError))


def test_no_module_is_imported(tmp_path, monkeypatch):
    """Neither a module that is not imported yet, nor an attribute that a package would import when it is asked."""
    (tmp_path / "surprise.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="imported module"):
        pytree_json.decode({"dataclass": ["surprise:Class", {}]}, ("surprise",))
    monkeypatch.setattr(sys.modules[__name__], "__getattr__", lambda name: pytest.fail(name), raising=False)
    with pytest.raises(ValueError, match="name of a class"):
        pytree_json.decode({"dataclass": [f"{__name__}:lazy", {}]}, PACKAGES)
