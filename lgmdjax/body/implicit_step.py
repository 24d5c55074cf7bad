"""MJX's step for any model, differentiable in both modes: the solver is differentiated at its solution, not its loop.

The solver computes the acceleration a at which the forces on the robot are in balance,

    r(a) = M a - f_smooth - J' f(J a - a_ref) = 0,

with the mass matrix M, all forces except those of constraints f_smooth, the Jacobian J of the constraints (contacts,
limits, equalities, dry friction), and their force f. The solver is a `lax.while_loop`, which JAX cannot differentiate
in reverse mode. By the implicit function theorem the derivative of its solution is da = -(dr/da)^-1 dr, where dr is
taken at fixed a (`lax.custom_root`). -f is the gradient of a convex function, so dr/da is symmetric and positive
definite.

| part of a model                                        | here                                                     |
| ------------------------------------------------------ | -------------------------------------------------------- |
| cones: pyramidal, elliptic; condim 1, 3, 4, 6          | works                                                    |
| equality constraints: connect, weld, joint, tendon     | works                                                    |
| limits of joints and tendons; dry friction             | works                                                    |
| tendons: fixed, spatial, wrapped around geoms outside  | works                                                    |
| integrators: Euler, implicitfast                       | works                                                    |
| tendons that wrap around the inside of a geom          | refused: MJX's derivative is NaN in reverse mode         |
| contacts of cylinders and ellipsoids, but with planes  | refused: MJX searches for them; derivatives are wrong    |
| powers of solimp that are no whole numbers             | refused where they are known: NaN in reverse mode        |
| integrator RK4                                         | refused: it solves four times within MJX                 |
| implementations of MJX other than JAX                  | refused: they have no derivative                         |

The step consists of MJX's public stages, with its own solver, so that its results equal those of `mjx.step` to the last
bit. Only `Context`, which defines r, is private to MJX. Hence `SUPPORTED_MJX`.

Gradient: that of the smooth piece that contains the current state, without contributions from contacts that begin or
end. Zero with respect to the initial guess of the solver. It is as exact as the solver's solution: allow the solver
enough iterations (`<option iterations= tolerance=>`).
"""

from collections.abc import Callable
from importlib.metadata import version

import jax
import mujoco
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lgmdjax.errors import InputError
from lgmdjax.runtime.mjx import Context, geom_pairs, mjx

SUPPORTED_MJX = (
    "3.17",
)  # minor versions of mujoco-mjx whose `Context` was reviewed and whose step equals ours (tests)
SEARCHED = {mjx.GeomType.CYLINDER, mjx.GeomType.ELLIPSOID}  # shapes whose contacts MJX finds by minimisation
INTEGRATORS = {mjx.IntegratorType.EULER: mjx.euler, mjx.IntegratorType.IMPLICITFAST: mjx.implicit}


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advance the physics by a time step, as `mjx.step` does.

    ```python
    model = mjx.put_model(mujoco.MjModel.from_xml_path("walker.xml"), impl="jax")
    height = lambda ctrl: implicit_step.step(model, data.replace(ctrl=ctrl)).qpos[2]
    jax.grad(height)(data.ctrl)
    ```

    Args:
        model: any model of MJX's JAX implementation.
        data: its state.

    Raises InputError for a version of MJX or a part of a model that is not supported (module's table).
    """
    check_supported(model)
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    if data._impl.efc_J.size == 0:  # pyright: ignore[reportAttributeAccessIssue] - of MJX's JAX implementation
        # Without constraints there is nothing to solve. Like MJX, leave out the sensors of acceleration.
        data = data.replace(qacc=data.qacc_smooth)
    else:
        data = mjx.sensor_acc(model, solve(model, data))
    return INTEGRATORS[model.opt.integrator](model, data)


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
    """Raise InputError for a version of MJX or a part of a model that is not supported (module's table)."""
    found = version("mujoco-mjx")
    if found.rpartition(".")[0] not in SUPPORTED_MJX:
        raise InputError(
            f"expected mujoco-mjx {' or '.join(SUPPORTED_MJX)}, whose solver lgmdjax can differentiate, got {found};"
            f" pip install 'mujoco=={SUPPORTED_MJX[-1]}.*' 'mujoco-mjx=={SUPPORTED_MJX[-1]}.*'"
        )
    if model.impl != mjx.Impl.JAX:
        raise InputError(
            f'expected a model of MJX\'s implementation in JAX, got {model.impl.name}; mjx.put_model(model, impl="jax")'
        )
    if model.opt.integrator not in INTEGRATORS:
        raise InputError(
            f'expected a model with integrator="Euler" or "implicitfast", got {model.opt.integrator.name}; '
            "change <option integrator> in its XML"
        )
    _check_shapes(model)
    for name in (field for field in model.__dataclass_fields__ if "_solimp" in field):
        power = getattr(model, name)[:, 4]
        if not isinstance(power, Tracer) and np.any(power != np.round(power)):
            raise InputError(
                f"expected whole numbers as the power of solimp, got {name} {np.asarray(power).max():g}, whose "
                "derivative is NaN; choose 1, 2 or 3"
            )


def _check_shapes(model: mjx.Model) -> None:
    """Raise InputError for tendons and contacts whose derivative is wrong."""
    if model._impl.is_wrap_inside.any():  # pyright: ignore[reportAttributeAccessIssue] - of MJX's JAX implementation
        raise InputError(
            "expected tendons that wrap around the outside of geoms, got one with its sidesite inside a geom, whose "
            "derivative is NaN; move the sidesite"
        )
    for first, second, _ in geom_pairs(model):
        kinds = {mjx.GeomType(model.geom_type[geom]) for geom in (first, second)}
        if kinds & SEARCHED and mjx.GeomType.PLANE not in kinds:
            names = " and ".join(
                mjx.id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or str(geom) for geom in (first, second)
            )
            raise InputError(
                f"expected no contacts of cylinders and ellipsoids except with planes, got the pair of geoms {names}, "
                "whose derivative is wrong; use capsules, or leave the pair out (contype, conaffinity)"
            )


def _solver_context(model: mjx.Model, data: mjx.Data, acceleration: Float[Array, " dofs"]) -> Context:
    """Return MJX's context at an acceleration, which holds M a and the constraint forces."""
    return Context.create(model, data.replace(qacc=acceleration), grad=False)


def _with_gradient_of(value: Array, other: Array) -> Array:
    """Return `value` with the gradient of `other`."""
    return value + (other - jax.lax.stop_gradient(other))
