"""Walks of a batch of robots in C MuJoCo, with pictures by OpenGL, recorded as by the closed loop in MJX.

The timing is that of a real robot. CPG, servos and physics advance 180 times a second, with or without a new picture.
The cameras take a picture 30 or 25 times a second; when it arrives (`camera_faults`), detectors and policy process it.
After a touch the robot is put at its next start, in the next frame of 1/30 s, as in `simulation.closed_loop`.

A touch is a contact of any of the robot's geoms with a wall or an obstacle, in some physics step. The clearance is the
smallest distance of trunk and legs (`hexapod.CAPSULES`) at the end of a frame, and zero after a touch.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from tqdm import tqdm

from lgmdjax.body import hexapod, servo_faults
from lgmdjax.control import policies
from lgmdjax.control.names import PolicyName
from lgmdjax.runtime import interruption
from lgmdjax.sensors import laser
from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.assembly import select_policy
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS, Record, Room
from lgmdjax.transfer import nervous_systems, robot_model
from lgmdjax.transfer.cube_camera import CubeCamera
from lgmdjax.transfer.faults import Faults, draw
from lgmdjax.transfer.names import FaultName
from lgmdjax.world import arena, mujoco_world
from lgmdjax.world.mujoco_world import PHOTOGRAPHIC, Style

RAY_GROUPS = np.array([1, 1, 0, 0, 0, 0], np.uint8)  # what the scanner sees: all that can be touched, except the robot
FAR = 10.0  # m; obstacles farther than this are not measured


@dataclass(frozen=True, kw_only=True)
class World:
    """Differences from the world in which the robot was trained, besides the engine."""

    style: Style = PHOTOGRAPHIC
    faults: tuple[FaultName, ...] = ()
    seed: int = 0  # of textures, shapes and faults


UNCHANGED = World()


class _Body(NamedTuple):
    """One robot in its room."""

    model: mujoco.MjModel
    data: mujoco.MjData
    room: arena.Arena
    starts: np.ndarray
    touchable: np.ndarray  # which geoms are walls and obstacles
    capsules: np.ndarray  # ids of geoms
    solids: np.ndarray  # ids of geoms


def walk(
    robot: closed_loop.Params,
    rooms: Room,
    seconds: float,
    policy: PolicyName,
    world: World = UNCHANGED,
    *,
    label: str = "",
) -> Record:
    """Return the record, axes (robot, frame), of a robot that walks in each of some rooms.

    All robots advance together, so that one call of the nervous system serves all of them.
    """
    count = len(rooms.starts)
    drawn = [draw(jax.random.fold_in(rooms.key[k], world.seed), *world.faults) for k in range(count)]
    bodies = [_body(robot, jax.tree.map(lambda leaf, k=k: leaf[k], rooms), drawn[k], world, k) for k in range(count)]
    chosen = policies.get_policy(policy)
    with ExitStack() as stack:
        cameras = [
            stack.enter_context(CubeCamera(body.model, robot.camera, lens=own.lens))
            for body, own in zip(bodies, drawn if chosen.uses_camera else [], strict=False)
        ]
        batch = _Batch(select_policy(_in_single_precision(robot), chosen), bodies, cameras, _stack(drawn), rooms.key)
        frames = round(seconds * FRAME_RATE)
        rows = list(tqdm(batch.frames(frames), total=frames, desc=label or policy, unit="frame", mininterval=2.0))
    return Record(**{f.name: np.stack([row[f.name] for row in rows], axis=1) for f in fields(Record)})


class _Batch:
    """Robots that walk together, with everything that changes."""

    def __init__(
        self,
        robot: closed_loop.Params,
        bodies: Sequence[_Body],
        cameras: Sequence[CubeCamera],
        faults: Faults,
        keys: jax.Array,
    ):
        self.robot, self.bodies, self.cameras, self.faults, self.keys = robot, bodies, cameras, faults, keys
        count = len(bodies)
        self.states = nervous_systems.init_batch(robot, faults, keys)
        self.resets, self.ok = np.zeros(count, np.int32), np.ones(count, bool)
        self.is_first, self.contact = np.ones(count, bool), np.zeros(count, bool)
        self.bearings = np.asarray(laser.bearings(robot.laser), float)

    def frames(self, count: int) -> Iterator[dict[str, np.ndarray]]:
        """Walk for `count` frames; yield the fields of the record for each frame."""
        period = FRAME_RATE * SUBSTEPS / self.faults.rate
        for frame in range(count):
            interruption.check()
            self._lift()
            for body in self.bodies:
                mujoco_world.place_obstacles(body.model, body.data, body.room, frame / FRAME_RATE)
            row, touched = self._pose(frame), np.zeros(len(self.bodies), bool)
            for substep in range(frame * SUBSTEPS, (frame + 1) * SUBSTEPS):
                if int(substep / period) > int((substep - 1) / period) or substep == 0:
                    self._look()
                touched |= self._move()
            self.contact, self.is_first = touched, np.zeros(len(touched), bool)
            yield row | self._outcome(touched)

    def _lift(self) -> None:
        """Put robots that touched something at their next start."""
        lifted = self.contact & self.ok
        if lifted.any():
            self.resets, self.is_first = self.resets + lifted, self.is_first | lifted
            keys = jax.vmap(jax.random.fold_in)(self.keys, jnp.asarray(self.resets))
            self.states = nervous_systems.restart_batch(self.robot, self.faults, self.states, keys, jnp.asarray(lifted))
            for index in np.flatnonzero(lifted).tolist():
                body = self.bodies[index]
                robot_model.reset(body.model, body.data, body.starts[self.resets[index] % len(body.starts)])

    def _look(self) -> None:
        """Take pictures and scans, and let the nervous systems process what arrives."""
        height, width = self.robot.camera.height, self.robot.camera.width
        pictures = np.zeros((len(self.bodies), 2, height, width), np.float32)
        for index, eyes in enumerate(self.cameras):
            pictures[index] = eyes.render(self.bodies[index].data)
        ranges = np.stack([self._scan(body) for body in self.bodies])
        self.states = nervous_systems.process_picture_batch(self.robot, self.faults, self.states, pictures, ranges)

    def _move(self) -> np.ndarray:
        """Advance by one physics step; return which robots touched something in it."""
        self.states, targets = nervous_systems.next_targets_batch(self.robot, self.faults, self.states)
        targets = np.asarray(targets, float).reshape(len(self.bodies), -1)
        touched = np.zeros(len(self.bodies), bool)
        for index in np.flatnonzero(self.ok).tolist():
            body = self.bodies[index]
            body.data.ctrl[:] = targets[index]
            mujoco.mj_step(body.model, body.data)
            touched[index] = body.touchable[body.data.contact.geom].any()
            self.ok[index] = is_healthy(body.model, body.data)
        return touched

    def _scan(self, body: _Body) -> np.ndarray:
        """Return the distances along the scanner's rays, at most its range."""
        site, limit = body.data.site("laser"), float(self.robot.laser.max_range)
        turn = site.xmat.reshape(3, 3)
        rays = np.cos(self.bearings)[:, None] * turn[:, 0] + np.sin(self.bearings)[:, None] * turn[:, 1]
        count = len(rays)
        hit, distance = np.empty(count, np.int32), np.empty(count)
        mujoco.mj_multiRay(
            body.model, body.data, site.xpos, rays.ravel(), RAY_GROUPS, 1, -1, hit, distance, None, count, limit
        )
        return np.where((distance < 0) | (distance > limit), limit, distance).astype(np.float32)

    def _pose(self, frame: int) -> dict[str, np.ndarray]:
        qpos = np.stack([body.data.qpos for body in self.bodies]).astype(np.float32)
        return {
            "time": np.full(len(qpos), frame / FRAME_RATE, np.float32),
            "position": qpos[:, :3],
            "quaternion": qpos[:, 3:7],
            "joints": qpos[:, 7:].reshape(-1, 6, 3),
            "is_first": self.is_first,
            "resets": self.resets,
            "ok": self.ok.copy(),
        }

    def _outcome(self, touched: np.ndarray) -> dict[str, np.ndarray]:
        states = jax.tree.map(
            np.asarray,
            (self.states.response, self.states.distances, self.states.corridor, self.states.label,
             self.states.controller.velocity),
        )  # fmt: skip
        response, distances, corridor, label, velocity = states
        clearance = np.array([_clearance(body) for body in self.bodies], np.float32)
        return vars(response) | {
            "distances": distances,
            "corridor": corridor,
            "label": label,
            "velocity": velocity,
            "clearance": np.where(touched, np.minimum(clearance, 0), np.maximum(clearance, 1e-6)).astype(np.float32),
            "contact": touched,
        }


def is_healthy(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """Return whether the state is finite and the robot on its feet, as `hexapod.is_healthy` does."""
    height, (x, y) = data.qpos[2] / model.key("stance").qpos[2], data.qpos[4:6]
    upright = 1 - 2 * (x * x + y * y) > hexapod.MIN_UPRIGHT
    return bool(
        upright and hexapod.MIN_TRUNK_HEIGHT < height < hexapod.MAX_TRUNK_HEIGHT and np.isfinite(data.qvel).all()
    )


def _body(robot: closed_loop.Params, room: Room, faults: Faults, world: World, index: int) -> _Body:
    model = robot_model.build(room.arena, world.style, seed=world.seed + index, body=robot.body)
    model = servo_faults.apply_to_model(model, faults.body)
    data, starts = mujoco.MjData(model), np.asarray(room.starts, float)
    robot_model.reset(model, data, starts[0])
    touchable = mujoco_world.touchable(model)
    capsules = np.array([model.geom(name).id for name in hexapod.CAPSULES])
    return _Body(
        model, data, jax.tree.map(np.asarray, room.arena), starts, touchable, capsules, np.flatnonzero(touchable)
    )


def _clearance(body: _Body) -> float:
    """Return the distance of trunk and legs to the nearest wall or obstacle, at most `FAR`."""
    nearest = FAR
    for solid in body.solids:
        for capsule in body.capsules:
            nearest = min(nearest, mujoco.mj_geomDistance(body.model, body.data, capsule, solid, nearest, None))
    return nearest


def _in_single_precision(robot: closed_loop.Params) -> closed_loop.Params:
    return jax.tree.map(_narrow, robot)


def _stack(drawn: Sequence[Faults]) -> Faults:
    return jax.tree.map(lambda *leaves: _narrow(np.stack([np.asarray(leaf) for leaf in leaves])), *drawn)


def _narrow(leaf: jax.Array | np.ndarray | float) -> np.ndarray:
    """Return an array in single precision, so that one compiled program serves both settings of JAX."""
    array = np.asarray(leaf)
    return array.astype({"f": np.float32, "i": np.int32}.get(array.dtype.kind, array.dtype))
