"""The differentiable step on models of other kinds: a pendulum, an ant, a humanoid; cones, tendons and equalities."""

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from derivatives import DerivativeCheck
from mujoco import mjx

from lgmdjax.body import implicit_step
from lgmdjax.errors import InputError

OPTION = '<option timestep="0.005" iterations="50" ls_iterations="50" tolerance="1e-14" {}/>'
FLOOR = '<geom type="plane" size="1 1 1"/>'
GHOST = 'contype="0" conaffinity="0"'  # touches nothing: pairs that never touch cost time


def model_of(body: str, rest: str = "", options: str = "") -> mujoco.MjModel:
    """Compile an MJCF with these bodies and other elements."""
    compiler = '<compiler angle="degree" autolimits="true"/>'
    xml = f"<mujoco>{compiler}{OPTION.format(options)}<worldbody>{body}</worldbody>{rest}</mujoco>"
    return mujoco.MjModel.from_xml_string(xml)


def limb(end: str, more: str = GHOST) -> str:
    return f'<geom type="capsule" size="0.04" fromto="0 0 0 {end}" mass="0.3" {more}/>'


def hinge(name: str, axis: str, at: str, inside: str, more: str = "") -> str:
    """Return a body with a hinge."""
    return f'<body pos="{at}"><joint name="{name}" axis="{axis}" damping="0.2" armature="0.01" {more}/>{inside}</body>'


def motors(*joints: str) -> str:
    return "".join(f'<motor joint="{joint}" gear="2"/>' for joint in joints)


def pendulum() -> mujoco.MjModel:
    """Two links without any constraint."""
    lower = hinge("lower", "0 1 0.2", "0.4 0 0", limb("0.3 0.05 0"))
    return model_of(
        hinge("upper", "0 1 0", "0 0 1", limb("0.3 0 0") + lower), f"<actuator>{motors('upper')}</actuator>"
    )


def ant() -> mujoco.MjModel:
    """Four legs of two hinges on a sphere, with elliptic friction cones."""
    legs, names = "", []
    for k, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        shank = hinge(f"ankle_{k}", f"{-y} {x} 0", f"{0.2 * x} {0.2 * y} 0", limb(f"{0.2 * x} {0.2 * y} -0.25", ""))
        thigh = limb(f"{0.2 * x} {0.2 * y} 0") + shank
        legs += hinge(f"hip_{k}", "0 0 1", f"{0.14 * x} {0.14 * y} 0", thigh, 'range="-30 4"')
        names += [f"hip_{k}", f"ankle_{k}"]
    trunk = f'<body pos="0 0 0.28"><freejoint/><geom type="sphere" size="0.15" mass="1" {GHOST}/>{legs}</body>'
    return model_of(FLOOR + trunk, f"<actuator>{motors(*names)}</actuator>", 'cone="elliptic"')


def humanoid() -> mujoco.MjModel:
    """A torso on two legs, with pyramidal cones, limits, and tendons that couple hip and knee, one at its limit."""
    legs, tendons, names = "", "", []
    foot = '<geom type="sphere" size="0.07" pos="0.03 0 -0.33" mass="0.2"/>'
    for side, y in (("right", -0.1), ("left", 0.1)):
        knee = hinge(f"knee_{side}", "0 1 0", "0 0 -0.35", limb("0 0 -0.3") + foot, 'range="9 110"')
        legs += hinge(f"hip_{side}", "0 1 0", f"0 {y} -0.2", limb("0 0 -0.3") + knee, 'range="-60 20"')
        coupled = f'<joint joint="hip_{side}" coef="0.5"/><joint joint="knee_{side}" coef="-0.5"/>'
        tendons += f'<fixed limited="true" range="-1 {-0.02 if y > 0 else 0.3}">{coupled}</fixed>'
        names += [f"hip_{side}", f"knee_{side}"]
    arm = hinge("shoulder", "1 0 0", "0 0.2 0.1", limb("0 0 -0.3"), 'stiffness="1"')
    torso = f'<geom type="capsule" size="0.1" fromto="0 0 -0.1 0 0 0.15" mass="4" {GHOST}/>'
    muscle = '<muscle joint="shoulder" lengthrange="-1 1" force="5"/>'
    body = f'<body pos="0 0 0.94"><freejoint/>{torso}{legs}{arm}</body>'
    return model_of(FLOOR + body, f"<tendon>{tendons}</tendon><actuator>{motors(*names)}{muscle}</actuator>")


def mechanism(cone: str) -> mujoco.MjModel:
    """Arms with every equality constraint, a wrapped and a coupling tendon and dry friction, and a ball that rolls."""
    tip = '<site name="tip" pos="0.3 0 0"/>'
    arm = hinge("upper", "0 1 0", "0 0 1", limb("0.3 0 0") + hinge("lower", "0 1 0", "0.4 0 0", limb("0.3 0 0") + tip))
    arm = arm.replace("<body", '<body name="first"', 1)
    second = hinge("second", "0 1 0", "0 0.3 1", limb("0.3 0 0"), 'frictionloss="0.3"').replace(
        "<body", '<body name="second"'
    )
    third = '<body name="third" pos="0 0.6 1"><joint type="ball" damping="0.2"/>' + limb("0.3 0.01 0") + "</body>"
    held = '<body name="held" pos="0.3 0.6 1.3"><freejoint/>' + limb("0.1 0 0") + "</body>"
    ball = f'<body pos="0 1 0.095"><freejoint/><geom type="sphere" size="0.1" condim="6" mass="0.5"/></body>{FLOOR}'
    wheel = (
        f'<geom name="wheel" type="sphere" size="0.1" pos="0.6 0 1.25" {GHOST}/><site name="wall" pos="0.6 0.02 1.5"/>'
    )
    equalities = (
        '<connect body1="third" body2="held" anchor="0.3 0 0"/><weld body1="held" body2="world"/>'
        '<joint joint1="second" joint2="upper" polycoef="0 0.5 0.1 0 0"/><tendon tendon1="sum"/>'
    )
    tendons = (
        '<fixed name="sum"><joint joint="upper" coef="1"/><joint joint="lower" coef="-0.6"/></fixed>'
        '<spatial stiffness="30"><site site="wall"/><geom geom="wheel"/><site site="tip"/></spatial>'
    )
    rest = f"<equality>{equalities}</equality><tendon>{tendons}</tendon><actuator>{motors('upper')}</actuator>"
    return model_of(arm + second + third + held + ball + wheel, rest, f'cone="{cone}"')


class Start(NamedTuple):
    """What the derivatives are taken of."""

    qpos: jax.Array
    qvel: jax.Array
    ctrl: jax.Array


class Simulation:
    """Some steps of a model, from a state that moves, with its hinges bent by 0.1 rad."""

    def __init__(self, body: mujoco.MjModel, steps: int = 4):
        self.model, self.steps = mjx.put_model(body, impl="jax"), steps
        data = mjx.make_data(self.model)
        # Under x64 some indices of a step are wider than those of `make_data`.
        types = jax.eval_shape(lambda data: mjx.step(self.model, data), data)
        self.data = jax.tree.map(lambda leaf, kind: jnp.asarray(leaf, kind.dtype), data, types)
        qpos, velocity = body.qpos0.copy(), 0.3 * np.random.default_rng(0).normal(size=body.nv)
        qpos[body.jnt_qposadr[body.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] += 0.1
        self.start = Start(jnp.asarray(qpos), jnp.asarray(velocity), jnp.full(body.nu, 0.2))

    def run(self, start: Start, step=implicit_step.step):
        """Return positions, velocities and accelerations after each step."""

        def forward(data, _):
            data = step(self.model, data)
            return data, (data.qpos, data.qvel, data.qacc)

        return jax.lax.scan(forward, self.data.replace(**start._asdict()), length=self.steps)[1]

    def loss(self, start: Start) -> jax.Array:
        """Return a number that depends on all of them."""
        rows = zip((3.0, 1.0, 0.01), self.run(start), strict=True)
        return jnp.asarray(sum(jnp.sum(jnp.sin(scale * row)) for scale, row in rows))

    def active_rows(self) -> np.ndarray:
        """Return which rows of constraints act in the first step."""
        data = jax.jit(mjx.forward)(self.model, self.data.replace(**self.start._asdict()))
        return np.asarray(data._impl.efc_force) != 0


def test_derivatives_of_a_pendulum_agree():
    """It has no constraint, so that there is nothing to solve."""
    simulation = Simulation(pendulum(), steps=20)
    assert simulation.data._impl.efc_J.size == 0
    DerivativeCheck(simulation.loss).assert_agree(simulation.start)


@pytest.mark.slow
def test_derivatives_of_an_ant_agree():
    """Its feet slip, within elliptic cones, and its hips are beyond their limits."""
    simulation = Simulation(ant())
    DerivativeCheck(simulation.loss).assert_agree(simulation.start, step=1e-7)


@pytest.mark.extended
@pytest.mark.slow
def test_derivatives_of_a_humanoid_agree():
    simulation = Simulation(humanoid())
    assert simulation.active_rows().sum() >= 3
    DerivativeCheck(simulation.loss).assert_agree(simulation.start, step=1e-7)


@pytest.mark.extended
@pytest.mark.slow
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_derivatives_of_equalities_and_tendons_agree_with_both_cones(cone):
    simulation = Simulation(mechanism(cone))
    assert simulation.active_rows()[:11].all()  # 3 of connect, 6 of weld, joint, tendon
    DerivativeCheck(simulation.loss).assert_agree(simulation.start, step=1e-7)


@pytest.mark.extended
@pytest.mark.slow
@pytest.mark.parametrize("build", [pendulum, ant, humanoid, lambda: mechanism("elliptic")])
def test_steps_equal_those_of_mjx(build):
    simulation = Simulation(build())
    ours, theirs = (
        jax.jit(lambda start, step=step: simulation.run(start, step))(simulation.start)
        for step in (implicit_step.step, mjx.step)
    )
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_what_has_no_derivative_is_refused_by_name():
    model = mjx.put_model(pendulum(), impl="jax")
    other = model.replace(opt=model.opt.replace(integrator=mjx.IntegratorType.RK4))
    with pytest.raises(InputError, match=re.escape('integrator="Euler" or "implicitfast", got RK4')):
        implicit_step.check_supported(other)
    implicit_step.check_supported(model.replace(opt=model.opt.replace(integrator=mjx.IntegratorType.IMPLICITFAST)))
    power = model.jnt_solimp.at[:, 4].set(1.5)
    with pytest.raises(InputError, match=r"power of solimp, got jnt_solimp 1\.5"):
        implicit_step.check_supported(model.replace(jnt_solimp=power))
    drum = '<geom name="drum" type="cylinder" size="0.1 0.1"/>'
    ball = '<body pos="0 0 0.3"><freejoint/><geom name="ball" size="0.1"/></body>'
    with pytest.raises(InputError, match="got the pair of geoms ball and drum, whose derivative is wrong"):
        implicit_step.check_supported(mjx.put_model(model_of(drum + ball), impl="jax"))
    sites = '<site name="a" pos="-1 0 0"/><site name="b" pos="1 0 0"/><site name="side" pos="0.05 0 0"/>'
    tendon = '<tendon><spatial><site site="a"/><geom geom="drum" sidesite="side"/><site site="b"/></spatial></tendon>'
    with pytest.raises(InputError, match="its sidesite inside a geom"):
        implicit_step.check_supported(
            mjx.put_model(model_of(drum + sites + ball.replace("<geom", f"<geom {GHOST}"), tendon), impl="jax")
        )
