"""The adapter to Stable-Baselines3 (`experiments/ppo.py`), where it is installed."""

import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from point import SPEED, Point

pytest.importorskip("stable_baselines3")
PATH = Path(__file__).parents[2] / "experiments" / "ppo.py"


@pytest.fixture(scope="module")
def ppo():
    spec = importlib.util.spec_from_file_location("ppo", PATH)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_episodes_begin_again_at_once_and_show_their_last_observation(ppo):
    environment = ppo.VectorEnvironment(Point(steps=2), 10, seed=0)  # more than begin at once
    before = environment.reset()
    np.testing.assert_allclose(before[:, 1], before[:, 0] ** 2, rtol=1e-5)  # the privileged observation
    action = np.full((10, 1), 0.5, np.float32)
    moved, rewards, ends, _ = environment.step(action)
    np.testing.assert_allclose(moved[:, 0], before[:, 0] + SPEED * np.tanh(0.5), rtol=1e-5)
    np.testing.assert_allclose(rewards, -ppo.REWARD_SCALE * moved[:, 0] ** 2, rtol=1e-5)
    assert not ends.any()
    begun, _, ends, infos = environment.step(action)
    assert ends.all() and all(info["TimeLimit.truncated"] for info in infos)
    last = np.stack([info["terminal_observation"] for info in infos])
    np.testing.assert_allclose(last[:, 0], moved[:, 0] + SPEED * np.tanh(0.5), rtol=1e-5)
    assert len(np.unique(begun[:, 0])) == 10 and np.abs(begun[:, 0]).max() <= 1
    _, _, ends, _ = environment.step(action)
    assert not ends.any()
    assert len(environment.rewards) == 3


def test_training_returns_the_layers_of_the_actor(ppo):
    seen = []
    settings = {"discount": 0.9, "trace": 0.9, "units": (8,), "log_std": -1.0}
    environment = ppo.VectorEnvironment(Point(steps=20), 8, seed=0)
    layers = ppo.train(environment, commands=300, seed=0, report=seen.append, **settings)
    assert seen == [256, 512]
    assert [layer.kernel.shape for layer in layers] == [(1, 8), (8, 1)]
    assert all(bool(jnp.isfinite(layer.kernel).all()) for layer in layers)
