"""The gradient of one whole frame: reverse mode against forward mode, for every parameter on the way.

In a file of its own, since it takes minutes to compile.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax import (
    arena,
    camera,
    cpg,
    drivers,
    hexapod,
    lgmd,
    navigator,
    simulation,
)

# What runs five times is not worth optimising.
QUICKLY_COMPILED = {"xla_backend_optimization_level": 0}


def robot() -> simulation.Params:
    """A robot that looks and walks, its thresholds smooth."""
    return simulation.assemble(
        navigator.create(jax.random.key(3)),
        detector=lgmd.Params(threshold=0.5, suppression=30.0, suppression_width=10.0, smooth=True),
        # In one Runge-Kutta step: four take long to compile, and are tested by themselves.
        rhythm=cpg.Params(substeps=1),
        eyes=camera.Params(width=48, height=36, overlap=0.6),
    )


def room() -> simulation.Room:
    """A start half a metre from a box that stands to the left."""
    boxes = arena.place([[0.75, 0.4]], 0.2, 0.8, texture=(150.0, 0.8, 0.3, 0.3))
    scene = arena.empty_room((5.0, 4.0), boxes=boxes)
    return simulation.Room(arena=scene, starts=jnp.zeros((1, 3)), key=jax.random.key(0))


@pytest.mark.slow
def test_reverse_and_forward_mode_agree_on_the_command_error_of_a_frame():
    """Every leaf of LGMD, navigator, CPG and shaping network is reached: through legs, body, eyes and rule."""
    params, here, soft = robot(), room(), hexapod.differentiable(hexapod.build(), soft=True)

    def frame(nerves, state):
        # From a step to the next command, so that what moves the legs comes before what the eyes see.
        own = replace(params, controller=nerves)
        state, _ = simulation.move(own, soft, here.arena, state)
        state, senses = simulation.sense(own, here.arena, state)
        state, label = simulation.decide(own, state, senses, drivers.LEARNED)
        return jnp.mean((state.controller.velocity - jax.lax.stop_gradient(label)) ** 2), state

    def slope(nerves, along, state):
        return jax.jvp(lambda nerves: frame(nerves, state)[0], (nerves,), (along,))[1]

    reverse = jax.jit(jax.grad(frame, has_aux=True), compiler_options=QUICKLY_COMPILED)
    forward = jax.jit(slope, compiler_options=QUICKLY_COMPILED)

    nerves = params.controller
    state = simulation.init(params, soft, here, drivers.LEARNED)
    for _ in range(4):  # the eyes need three pictures before all of their layers are awake
        before = state
        gradient, state = reverse(nerves, before)

    paths, structure = jax.tree.flatten_with_path(gradient)
    rng = np.random.default_rng(0)
    for at, (path, leaf) in enumerate(paths):
        name = jax.tree_util.keystr(path)
        assert np.all(np.isfinite(leaf)), name
        assert np.any(leaf != 0), name
        along = [jnp.zeros_like(other) for _, other in paths]
        along[at] = jnp.asarray(rng.normal(size=leaf.shape))
        sloped = forward(nerves, jax.tree.unflatten(structure, along), before)
        np.testing.assert_allclose(jnp.vdot(leaf, along[at]), sloped, rtol=1e-6, err_msg=name)
