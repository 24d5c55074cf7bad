"""The simulated robot's body in C MuJoCo: the package's hexapod among the obstacles of a room, moved by its servos.

Every obstacle and wall is a geom of its own shape here, while `body.hexapod` moves one barrier in front of each part.
The trunk can lie on the floor, so the robot can sit. The servos follow their control tables: goal position, moving
speed, torque and torque limit. A servo moves its set point toward the goal at the moving speed. Without torque its
motor does nothing, and only the friction of its gears remains.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from lgmdjax.body import hexapod
from lgmdjax.hardware import ax_servo, postures
from lgmdjax.hardware.ax_servo import Address
from lgmdjax.hardware.joint_map import JointMap, to_angles, to_positions
from lgmdjax.hardware.simulated_servos import ServoBank
from lgmdjax.world import arena
from lgmdjax.world.obstacles import Prisms

WALL = 0.1  # m, half thickness
OBSTACLE, FLOOR = 2, 4  # contact bits of geoms that touch the robot
TRUNK = ("trunk_left", "trunk_right", "trunk_battery", "trunk_shoulders", "bumper")
START_HEIGHT = 0.045  # m, of the trunk's centre above the floor, from which it drops onto it
GEAR_FRICTION = 0.12  # N m, of a servo without torque
FREE_SPEED = 6.18  # rad/s, of a servo whose moving speed is 0


@dataclass(frozen=True, kw_only=True)
class Contacts:
    """Contacts of the robot with obstacles and walls."""

    obstacle: bool
    names: tuple[str, ...]  # names of the robot's geoms in contact


class Body:
    """The robot in a room.

    Args:
        room: the room, whose obstacles stay at rest.
        servos: the joint map.
        bank: the servos, whose tables the body reads and writes.
    """

    def __init__(self, room: arena.Arena, servos: JointMap, bank: ServoBank):
        self.model = _compile(room)
        self.data = mujoco.MjData(self.model)
        self._map, self._bank = servos, bank
        self._force = float(self.model.actuator_forcerange[0, 1])
        self._gain, self._bias = self.model.actuator_gainprm.copy(), self.model.actuator_biasprm.copy()
        self._addresses = self.model.jnt_qposadr[self.model.actuator_trnid[:, 0]]
        self._dofs = self.model.jnt_dofadr[self.model.actuator_trnid[:, 0]]
        self._hexapod = {self.model.geom(name).id for name in hexapod.CAPSULES}
        self._set_start(room)
        self.setpoints = self.angles().reshape(18)

    def angles(self) -> Float[np.ndarray, "6 3"]:
        """Return the joint angles [rad]."""
        return self.data.qpos[self._addresses].reshape(6, 3).copy()

    def pose(self) -> hexapod.Pose:
        """Return the trunk's pose."""
        return hexapod.Pose(position=jnp.array(self.data.qpos[:3]), quaternion=jnp.array(self.data.qpos[3:7]))  # copies

    def acceleration(self) -> Float[np.ndarray, "3"]:
        """Return what an accelerometer in the trunk measures at rest [m/s2], in the trunk's frame."""
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, self.data.qpos[3:7])
        return matrix.reshape(3, 3).T @ -self.model.opt.gravity

    def torques(self) -> Bool[np.ndarray, "18"]:
        """Return which servos have torque."""
        return self._bank.entries(Address.TORQUE_ENABLE) > 0

    def goals(self) -> Float[np.ndarray, "18"]:
        """Return the goals of the servos [rad]."""
        return to_angles(self._map, self._bank.entries(Address.GOAL_POSITION)).reshape(18)

    def step(self) -> None:
        """Advance by the time step of the model, and write the servos' measurements into their tables."""
        self._actuate()
        mujoco.mj_step(self.model, self.data)
        bank, turn = self._bank, self._map.directions
        speed, load = turn * self.data.qvel[self._dofs], turn * self.data.actuator_force / self._force
        bank.write_entries(Address.PRESENT_POSITION, np.array(to_positions(self._map, self.angles())))
        bank.write_entries(Address.PRESENT_SPEED, ax_servo.to_signed(speed / ax_servo.SPEED_UNIT))
        bank.write_entries(Address.PRESENT_LOAD, ax_servo.to_signed(ax_servo.HIGHEST * load))

    def contacts(self) -> Contacts:
        """Return which parts of the robot touch an obstacle or a wall."""
        names = []
        for contact in self.data.contact:
            first, second = int(contact.geom1), int(contact.geom2)
            for part, other in ((first, second), (second, first)):
                if part in self._hexapod and self.model.geom_contype[other] & OBSTACLE and contact.dist <= 0:
                    names.append(self.model.geom(part).name)
        return Contacts(obstacle=bool(names), names=tuple(names))

    def push_over(self) -> None:
        """Turn the robot onto its back, as after a fall."""
        self.data.qpos[2] = 0.15
        self.data.qpos[3:7] = [0.0, 1.0, 0.0, 0.0]
        self.data.qvel[:6] = 0.0

    def _actuate(self) -> None:
        """Set gains, torque limits, friction and set points of the motors for the next step."""
        torque = self._bank.entries(Address.TORQUE_LIMIT) / ax_servo.HIGHEST
        dead = np.array([servo.dead for servo in self._bank.servos.values()])
        active = self.torques() & (torque > 0) & ~dead
        self.model.actuator_gainprm[:] = active[:, None] * self._gain
        self.model.actuator_biasprm[:] = active[:, None] * self._bias
        self.model.actuator_forcerange[:] = np.outer(self._force * torque, [-1.0, 1.0])
        self.model.dof_frictionloss[self._dofs] = np.where(active, 0.0, GEAR_FRICTION)
        speed = self._bank.entries(Address.MOVING_SPEED) * ax_servo.SPEED_UNIT
        change = np.where(speed > 0, np.minimum(speed, FREE_SPEED), FREE_SPEED) * self.model.opt.timestep
        turned = self.setpoints + np.clip(self.goals() - self.setpoints, -change, change)
        self.setpoints = np.where(active, turned, self.data.qpos[self._addresses])
        self.data.ctrl[:] = self.setpoints

    def _set_start(self, room: arena.Arena) -> None:
        """Put the robot at the room's start, on its belly, with its legs at random angles near those of sitting."""
        x, y, yaw = np.asarray(room.start, float)
        legs = postures.sit_to_stand_postures()[0] + np.random.default_rng(0).uniform(-0.15, 0.15, (6, 3))
        low, high = hexapod.target_limits()
        self.data.qpos[:3] = x, y, START_HEIGHT
        self.data.qpos[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        self.data.qpos[self._addresses] = np.clip(legs, low, high).reshape(18)
        mujoco.mj_forward(self.model, self.data)


def _compile(room: arena.Arena) -> mujoco.MjModel:
    """Return the model of the robot in a room."""
    spec = mujoco.MjSpec.from_file(str(hexapod.xml_path()))
    for kind, shape in ((room.boxes, mujoco.mjtGeom.mjGEOM_BOX), (room.cylinders, mujoco.mjtGeom.mjGEOM_CYLINDER)):
        _add_prisms(spec, kind, shape)
    _add_walls(spec, room)
    for name in hexapod.CAPSULES:
        spec.geom(name).conaffinity |= OBSTACLE
    spec.geom("floor").contype = FLOOR
    for name in TRUNK[:-1]:
        spec.geom(name).conaffinity |= FLOOR
    return spec.compile()


def _add_prisms(spec: mujoco.MjSpec, prisms: Prisms, shape: mujoco.mjtGeom) -> None:
    for row in np.flatnonzero(np.asarray(prisms.top) > 0):
        (x, y), (a, b) = np.asarray(prisms.centre[row], float), np.asarray(prisms.half_size[row], float)
        bottom, top, yaw = (float(values[row]) for values in (prisms.bottom, prisms.top, prisms.yaw))
        half = 0.5 * (top - bottom)
        size = [a, b, half] if shape == mujoco.mjtGeom.mjGEOM_BOX else [a, half, 0.0]
        spec.worldbody.add_geom(
            type=shape,
            size=size,
            pos=[x, y, bottom + half],
            quat=[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)],
            contype=OBSTACLE,
            conaffinity=0,
        )


def _add_walls(spec: mujoco.MjSpec, room: arena.Arena) -> None:
    """Add the four walls, whose inner faces are the bounds of the room."""
    x_min, x_max, y_min, y_max = np.asarray(room.bounds, float)
    middle, half = 0.5 * np.array([x_min + x_max, y_min + y_max]), 0.5 * np.array([x_max - x_min, y_max - y_min])
    height = 0.5 * float(room.wall_height)
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        centre, size = middle.copy(), half + WALL
        centre[axis] += sign * (half[axis] + WALL)
        size[axis] = WALL
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[*size, height],
            pos=[*centre, height],
            contype=OBSTACLE,
            conaffinity=0,
        )
