"""MJX's step, differentiable in both modes: the contact solver is differentiated at its solution, not through its loop.

The solver looks for the acceleration a at which the forces on the robot are in balance,

    r(a) = M a - f_smooth - J' f(J a - a_ref) = 0,

M the mass matrix, f_smooth all forces but those of contacts and joint limits, J their Jacobian, f their force, which is
piecewise linear. It does so in a `lax.while_loop`, through which JAX has no reverse mode. What is wanted is not the
derivative of the search but that of what it found: by the implicit function theorem, da = -(dr/da)^-1 dr, with the
rest of r's arguments varied at fixed a (`lax.custom_root`). dr/da = M + J' D J over the active rows is symmetric and
positive definite.

The step is put together from MJX's public stages, its solver as it is among them, so that a walk is MJX's own in every
bit. One thing is taken from inside: `Context`, which says what r is. Hence `KNOWN`.

Gradient: of the smooth piece on which the step is; that a contact is made or lost moves no kink into it. None with
respect to the guess that the solver starts from.
"""

from importlib.metadata import version

import jax
from jaxtyping import Array, Float
from mujoco import mjx
from mujoco.mjx._src.solver import Context

from lgmdjax.errors import InputError

KNOWN = ("3.17",)  # minor versions of mujoco-mjx whose `Context` was read, and whose step ours equals (tests)


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advance the physics by a time step, as `mjx.step` does.

    Raises InputError for a version of MJX or an integrator that this is not written for.
    """
    check(model)
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    return mjx.euler(model, mjx.sensor_acc(model, solve(model, data)))


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Find acceleration and constraint forces, as `mjx.solve` does."""

    def residual(acceleration: Float[Array, " dofs"]) -> Float[Array, " dofs"]:
        forces = _forces(model, data, acceleration)
        return forces.Ma - data.qfrc_smooth - forces.qfrc_constraint

    def search(_, __):
        solved = mjx.solve(model, data)
        return solved.qacc, (solved.qfrc_constraint, solved._impl.efc_force)

    def balance(linear, force):
        return jax.scipy.linalg.solve(jax.jacfwd(linear)(force), force, assume_a="pos")

    acceleration, (joint_forces, forces) = jax.lax.custom_root(
        residual, data.qacc_smooth, search, balance, has_aux=True
    )
    # The solver's own forces, with the derivative of what they are at the acceleration that it found.
    found = _forces(model, data, acceleration)
    return data.tree_replace(
        {
            "qacc": acceleration,
            "qfrc_constraint": _with_slope(joint_forces, found.qfrc_constraint),
            "_impl.efc_force": _with_slope(forces, found.efc_force),
        }
    )


def check(model: mjx.Model) -> None:
    """Raise InputError unless `step` is known to equal MJX's."""
    found = version("mujoco-mjx")
    if found.rpartition(".")[0] not in KNOWN:
        raise InputError(
            f"expected mujoco-mjx {' or '.join(KNOWN)}, whose solver lgmdjax knows how to differentiate, found {found}:"
            f" pip install 'mujoco=={KNOWN[-1]}.*' 'mujoco-mjx=={KNOWN[-1]}.*'"
        )
    if model.opt.integrator != mjx.IntegratorType.EULER:
        raise InputError(
            f'expected a robot whose XML asks for integrator="Euler", got {model.opt.integrator.name}: change it there'
        )


def _forces(model: mjx.Model, data: mjx.Data, acceleration: Float[Array, " dofs"]) -> Context:
    return Context.create(model, data.replace(qacc=acceleration), grad=False)


def _with_slope(value: Array, same: Array) -> Array:
    return value + (same - jax.lax.stop_gradient(same))
