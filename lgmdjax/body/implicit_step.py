"""MJX's step, differentiable in both modes: the contact solver is differentiated at its solution, not through its loop.

The solver computes the acceleration a at which the forces on the robot are in balance,

    r(a) = M a - f_smooth - J' f(J a - a_ref) = 0,

with the mass matrix M, all forces except those of contacts and joint limits f_smooth, the Jacobian J of contacts and
limits, and their force f, which is piecewise linear. The solver is a `lax.while_loop`, which JAX cannot differentiate
in reverse mode. By the implicit function theorem the derivative of its solution is da = -(dr/da)^-1 dr, where dr is
taken at fixed a (`lax.custom_root`). dr/da = M + J' D J over the active rows is symmetric and positive definite.

The step consists of MJX's public stages, with its own solver, so that its results equal those of `mjx.step` to the last
bit. Only `Context`, which defines r, is private to MJX. Hence `SUPPORTED_MJX`.

Gradient: that of the smooth piece that contains the current state, without contributions from contacts that begin or
end. Zero with respect to the initial guess of the solver.
"""

from collections.abc import Callable
from importlib.metadata import version

import jax
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.runtime.mjx import Context, mjx

SUPPORTED_MJX = (
    "3.17",
)  # minor versions of mujoco-mjx whose `Context` was reviewed and whose step equals ours (tests)


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advance the physics by a time step, as `mjx.step` does.

    Raises InputError for a version of MJX or an integrator that is not supported.
    """
    check_supported(model)
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    return mjx.euler(model, mjx.sensor_acc(model, solve(model, data)))


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute acceleration and constraint forces, as `mjx.solve` does."""

    def residual(acceleration: Float[Array, " dofs"]) -> Float[Array, " dofs"]:
        context = _solver_context(model, data, acceleration)
        return context.Ma - data.qfrc_smooth - context.qfrc_constraint

    def find_root(_, __) -> tuple[Array, tuple[Array, Array]]:
        solved = mjx.solve(model, data)
        forces = solved._impl.efc_force  # pyright: ignore[reportAttributeAccessIssue] - of MJX's JAX implementation
        return solved.qacc, (solved.qfrc_constraint, forces)

    def solve_linear(linear: Callable[[Array], Array], force: Array) -> Array:
        return jax.scipy.linalg.solve(jax.jacfwd(linear)(force), force, assume_a="pos")

    acceleration, (joint_forces, forces) = jax.lax.custom_root(
        residual, data.qacc_smooth, find_root, solve_linear, has_aux=True
    )
    # The values are the solver's own forces; the derivatives are those of the forces at the acceleration found.
    context = _solver_context(model, data, acceleration)
    return data.tree_replace(  # pyright: ignore[reportReturnType] - declared as any PyTreeNode
        {
            "qacc": acceleration,
            "qfrc_constraint": _with_gradient_of(joint_forces, context.qfrc_constraint),
            "_impl.efc_force": _with_gradient_of(forces, context.efc_force),
        }
    )


def check_supported(model: mjx.Model) -> None:
    """Raise InputError unless `step` is known to equal `mjx.step`."""
    found = version("mujoco-mjx")
    if found.rpartition(".")[0] not in SUPPORTED_MJX:
        raise InputError(
            f"expected mujoco-mjx {' or '.join(SUPPORTED_MJX)}, whose solver lgmdjax can differentiate, got {found};"
            f" pip install 'mujoco=={SUPPORTED_MJX[-1]}.*' 'mujoco-mjx=={SUPPORTED_MJX[-1]}.*'"
        )
    if model.opt.integrator != mjx.IntegratorType.EULER:
        raise InputError(
            f'expected a robot whose XML asks for integrator="Euler", got {model.opt.integrator.name}; change it there'
        )


def _solver_context(model: mjx.Model, data: mjx.Data, acceleration: Float[Array, " dofs"]) -> Context:
    """Return MJX's context at an acceleration, which holds M a and the constraint forces."""
    return Context.create(model, data.replace(qacc=acceleration), grad=False)


def _with_gradient_of(value: Array, other: Array) -> Array:
    """Return `value` with the gradient of `other`."""
    return value + (other - jax.lax.stop_gradient(other))
