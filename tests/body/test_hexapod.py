"""The robot stands, walks against things and is stopped by them, and is the same robot in MJX and in C MuJoCo."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from reference import hexapod as reference
from scipy.spatial.transform import Rotation

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.locomotion import kinematics, tripod_gait
from lgmdjax.world import arena

STEPS = 18  # 0.1 s, a call of `run`
LANES = 6
MOTION = ["time", "ctrl", "qpos", "qvel", "xpos", "xquat", "xmat", "xipos", "geom_xpos", "geom_xmat", "site_xpos"]
MOTION += ["site_xmat", "subtree_com", "cvel"]
FORCES = ["qacc", "qacc_warmstart", "actuator_force", "qfrc_actuator", "qfrc_bias", "qfrc_passive", "qfrc_constraint"]


@pytest.fixture(scope="module")
def body() -> mujoco.MjModel:
    return hexapod.load()


@pytest.fixture(scope="module")
def model(body) -> mjx.Model:
    return hexapod.build(body)


@pytest.fixture(scope="module")
def run():
    """Walk LANES robots for STEPS, each in a room of its own."""

    def one(model, room, data, course):
        placed = hexapod.place_obstacles(model, room, data)

        def step(data, angles):
            data = hexapod.substep(placed, data, angles)
            return data, jnp.min(arena.clearance(room, *hexapod.capsules(placed, data)))

        return jax.lax.scan(step, data, course)

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0)))


def stacked(rooms):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)


def standing(model, starts) -> mjx.Data:
    return jax.vmap(lambda start: hexapod.reset(model, start))(jnp.asarray(starts, dtype=float))


def boxes(*rows) -> arena.Prisms:
    centre, half_size, yaw = (list(column) for column in zip(*rows, strict=True))
    return arena.place(jnp.asarray(centre), jnp.asarray(half_size), 0.4, yaw=jnp.asarray(yaw), count=3)


def cylinders(*rows) -> arena.Prisms:
    centre, radius = (list(column) for column in zip(*rows, strict=True))
    return arena.place(jnp.asarray(centre), jnp.asarray(radius)[:, None], 0.4, count=3)


def room(boxes: arena.Prisms | None = None, cylinders: arena.Prisms | None = None) -> arena.Arena:
    return arena.empty_room((12.0, 12.0), boxes=boxes or arena.parked(3), cylinders=cylinders or arena.parked(3))


def in_c(body: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(body)
    mujoco.mj_resetDataKeyframe(body, data, body.key("stance").id)
    return data


def test_lengths_masses_and_limits_are_the_data_sheets(body):
    geometry = kinematics.geometry(body)
    lengths = np.array([geometry.coxa, geometry.femur, geometry.tibia])
    np.testing.assert_allclose(lengths, [0.052, 0.066, 0.133], atol=1e-9)
    np.testing.assert_allclose(geometry.mounts[:, :2], reference.MOUNTS, atol=1e-9)
    np.testing.assert_allclose(geometry.mount_yaws, reference.MOUNT_YAWS, atol=1e-9)
    masses = [1.522, *[0.0247, 0.0858, 0.1718] * 6]
    np.testing.assert_allclose(body.body_mass[1:], masses, rtol=1e-6)
    assert body.body_inertia[1].max() < 0.02  # a 1.5 kg trunk of 0.3 m; published ones say 3 to 6
    limits = np.radians([[-75, 75], [-100, 100], [-102, 67]] * 6)
    np.testing.assert_allclose(body.jnt_range[1:], limits, atol=1e-9)
    np.testing.assert_allclose(body.actuator_ctrlrange, limits, atol=1e-9)
    np.testing.assert_allclose(body.actuator_forcerange, [[-1.5, 1.5]] * 18)
    assert body.opt.timestep * 6 * 30 == pytest.approx(1, abs=1e-12)


def test_eyes_look_forward_6_5_cm_apart_and_laser_is_3_cm_above_the_middle(body):
    pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.array([1.0, 0, 0, 0]))
    eyes, turned = hexapod.eye_poses(pose)
    np.testing.assert_allclose(eyes[0] - eyes[1], [0, 0.065, 0], atol=1e-9)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(hexapod.laser_pose(pose)[0], [0, 0, 0.03], atol=1e-9)
    bumper = body.geom("bumper")
    nose = bumper.pos[0] + bumper.size[1] + np.sqrt(bumper.size[0] ** 2 - eyes[0, 1] ** 2)
    assert eyes[0, 0] < nose  # a wall is touched before an eye goes through it


def test_default_stance_is_the_gaits_as_wide_as_the_papers_and_no_longer(body):
    feet = np.asarray(kinematics.forward(kinematics.geometry(body), jnp.asarray(hexapod.stance())))
    np.testing.assert_allclose(feet, tripod_gait.homes(tripod_gait.Gait()), atol=1e-5)
    length, width = np.ptp(feet[:, :2], axis=0)
    assert width == pytest.approx(0.40, rel=0.1)
    assert 0.30 < length < 0.45  # paper: about 0.45; the gait's feet stand closer in, for less sway (gait.Gait)
    data = in_c(body)
    mujoco.mj_kinematics(body, data)
    seen = body.geom_group == 2
    reach = np.abs(data.geom_xpos[seen, :2]).max(axis=0) + body.geom_size[seen, 0].max()
    assert np.all(reach < 0.25)  # knees included, it fits the paper's half metre


def test_stands_ten_seconds_in_c(body):
    data = in_c(body)
    for _ in range(1800):
        mujoco.mj_step(body, data)
    assert np.linalg.norm(data.qpos[:2]) < 0.005
    assert abs(data.qpos[2] - body.key("stance").qpos[2]) < 0.005
    assert abs(data.qpos[3]) > np.cos(np.radians(0.5) / 2)


@pytest.mark.slow
def test_stands_ten_seconds_in_mjx(model, run):
    starts = np.array([[0.3 * i, -0.2 * i, 0.7 * i] for i in range(LANES)])
    data = standing(model, starts)
    course = jnp.broadcast_to(jnp.asarray(hexapod.stance()), (LANES, STEPS, 6, 3))
    rooms = stacked([room()] * LANES)
    first = data.qpos
    for _ in range(100):
        data, _ = run(model, rooms, data, course)
    assert np.linalg.norm(data.qpos[:, :2] - starts[:, :2], axis=1).max() < 0.005
    assert np.abs(data.qpos[:, 2] - first[:, 2]).max() < 0.005
    turned = jax.vmap(lambda data: hexapod.yaw(hexapod.pose(data)))(data) - starts[:, 2]
    assert np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max() < np.radians(0.5)
    assert np.all(jax.vmap(hexapod.is_sound)(data))


def touching(body: mujoco.MjModel) -> list[arena.Arena]:
    """Rooms whose obstacles overlap the standing robot by 4 mm; the first has none."""
    data = in_c(body)
    mujoco.mj_kinematics(body, data)
    front, middle, _, rear = (data.body(f"{leg}_tibia").xpos[:2] for leg in hexapod.LEGS[:4])
    knee = body.geom("left_front_femur").size[0] - 0.004
    nose = np.array([body.geom("bumper").size[:2].sum() - 0.004, 0.0])

    def beside(point, direction, radius):
        direction = np.radians(direction)
        return point + radius * np.array([np.cos(direction), np.sin(direction)])

    wall = boxes((beside(front, 0, 0.2 + knee), (0.2, 2.0), 0.0))
    corner = boxes((beside(middle, 90, 0.1 * np.sqrt(2) + knee), (0.1, 0.1), np.pi / 4))
    pole = cylinders((beside(nose, 0, 0.1), 0.1))
    poles = cylinders((beside(front, 50, 0.1 + knee), 0.1), (beside(rear, -120, 0.08 + knee), 0.08))
    behind = boxes((beside(rear, 180, 0.2 + knee), (0.2, 2.0), 0.0))
    alone = [room(boxes=wall), room(boxes=corner), room(cylinders=pole), room(cylinders=poles)]
    return [room(), *alone, room(boxes=behind, cylinders=pole)]


def test_mjx_equals_c_after_a_kick(body, model, run):
    data = standing(model, np.zeros((LANES, 3)))
    kicks = 0.3 * np.random.default_rng(0).normal(size=(LANES, model.nv))
    data = data.replace(qvel=jnp.asarray(kicks))
    course = jnp.broadcast_to(jnp.asarray(hexapod.stance()), (LANES, STEPS, 6, 3))
    scenes = touching(body)
    # Tighter than a walk needs: accelerations are compared as well.
    tight = model.replace(opt=model.opt.replace(tolerance=jnp.full_like(model.opt.tolerance, 1e-10)))
    after, _ = run(tight, stacked(scenes), data, course)
    for lane, scene in enumerate(scenes):
        placed = hexapod.place_obstacles(model, scene, jax.tree.map(lambda x: x[0], data))
        twin = reference.twin(hexapod.load(), placed)
        twin.opt.tolerance = 1e-10
        there = in_c(twin)
        there.qvel[:] = kicks[lane]
        touches = 0
        for _ in range(STEPS):
            mujoco.mj_step(twin, there)
            touches += np.sum((there.contact.dim == 1) & (there.contact.dist < 0))
        assert (touches > 0) == (lane > 0)  # each leans on what was put there
        for field in MOTION + FORCES:
            here = np.asarray(getattr(after, field)[lane]).reshape(np.shape(getattr(there, field)))
            np.testing.assert_allclose(here, getattr(there, field), atol=1e-4, err_msg=f"{field}, lane {lane}")


HOMES = reference.MOUNTS + 0.1 * np.stack([np.cos(reference.MOUNT_YAWS), np.sin(reference.MOUNT_YAWS)], axis=-1)
# Nothing; a wall, a box's corner and a cylinder ahead; a cylinder and a box in the way of the left front leg alone.
AHEAD = (
    room(),
    room(boxes=boxes(((0.5, 0.0), (0.2, 2.0), 0.1))),
    room(boxes=boxes(((0.36, 0.0), (0.1, 0.1), np.pi / 4))),
    room(cylinders=cylinders(((0.32, 0.0), 0.1))),
    room(cylinders=cylinders(((0.33, 0.18), 0.08))),
    room(boxes=boxes(((0.36, 0.23), (0.1, 0.1), 0.0))),
)


def test_obstacles_stop_trunk_and_legs(model, run):
    """Three seconds at 0.1 m/s against things: the capsules stay out of them but for the give of the contact."""
    homes = np.column_stack([HOMES, np.full(6, -0.1)])
    courses = reference.tripod(540, (0.1, 0.1), homes).reshape(30, STEPS, 6, 3)
    rooms = stacked(AHEAD)
    start = jnp.zeros(3)
    data = jax.vmap(lambda _: hexapod.reset(model, start, jnp.asarray(courses[0, 0])))(jnp.arange(LANES))
    clearances = []
    for course in courses:
        data, clearance = run(model, rooms, data, jnp.broadcast_to(jnp.asarray(course), (LANES, STEPS, 6, 3)))
        clearances.append(clearance)
    least = np.concatenate(clearances, axis=1).min(axis=1)
    assert np.all(jax.vmap(hexapod.is_sound)(data))
    assert data.qpos[0, 0] > 0.25  # the free one got there
    assert np.all(np.asarray(data.qpos[1:4, 0]) < 0.17)  # those with a thing ahead of the trunk did not
    assert np.all(least[1:] < 0.002)  # all touched
    assert np.all(least[1:] > -0.012)  # and went in no deeper than the contact gives
    yaws = jax.vmap(lambda data: hexapod.yaw(hexapod.pose(data)))(data)
    assert np.abs(yaws[4:]).min() > 0.03  # held at one leg, a robot turns
    assert np.abs(yaws[0]) < 0.01


def barrier(placed: mjx.Model, shape: str) -> tuple[np.ndarray, float]:
    """Read a barrier's normal and how far it is from the origin, by SciPy."""
    index = hexapod.load().geom(f"before_{shape}").id
    quaternion = np.asarray(placed.geom_quat[index])
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-6)
    turned = Rotation.from_quat(quaternion, scalar_first=True)
    normal = turned.apply([0.0, 0.0, 1.0])
    return normal, float(normal @ np.asarray(placed.geom_pos[index]))


def test_barriers_touch_what_is_near_and_not_what_hangs(model):
    scene = room(
        boxes=boxes(((1.0, 0.0), (0.3, 0.5), 0.0)),
        cylinders=arena.place([[0.0, 0.5], [0.4, 0.0]], [[0.1], [0.5]], [0.4, 1.0], bottom=[0.0, 0.5], count=3),
    )
    placed = hexapod.place_obstacles(model, scene, hexapod.reset(model, jnp.zeros(3)))
    normal, offset = barrier(placed, "left_middle_tibia")
    np.testing.assert_allclose(normal, [0.0, -1.0, 0.0], atol=1e-6)
    assert offset == pytest.approx(-0.4)
    normal, offset = barrier(placed, "right_front_tibia")
    np.testing.assert_allclose(normal, [-1.0, 0.0, 0.0], atol=1e-6)
    assert offset == pytest.approx(-0.7)


def test_each_shape_is_as_far_from_its_barrier_as_from_what_is_nearest(model):
    """A room with a thing at the left front leg and another at the right rear one, about a robot that looks back."""
    things = cylinders(((0.30, 0.25), 0.05), ((-0.28, -0.25), 0.05), ((0.0, 0.45), 0.05))
    scene = room(cylinders=replace(things, centre=0.5 - things.centre))
    data = hexapod.reset(model, jnp.asarray([0.5, 0.5, jnp.pi]))
    placed = jax.jit(hexapod.place_obstacles)(model, scene, data)
    capsules = hexapod.capsules(model, jax.jit(mjx.kinematics)(model, data))
    clearance = np.asarray(arena.clearance(scene, *capsules))
    starts, ends, radii = map(np.asarray, capsules)
    for k, shape in enumerate(hexapod.CAPSULES):
        normal, offset = barrier(placed, shape)
        assert min(normal @ starts[k], normal @ ends[k]) - offset - radii[k] == pytest.approx(clearance[k], abs=1e-6)
    for shape, thing in {"left_front_tibia": 0, "right_rear_tibia": 1, "left_middle_tibia": 2}.items():
        normal, offset = barrier(placed, shape)
        assert normal[:2] @ np.asarray(scene.cylinders.centre[thing]) + 0.05 == pytest.approx(offset, abs=1e-6), shape


def test_servo_runs_no_faster_and_pulls_no_harder_than_an_ax_12a(body):
    free = mujoco.MjModel.from_xml_path(str(hexapod.xml_path()))
    free.opt.gravity[:] = 0
    data = in_c(free)
    data.qpos[2] = 5.0  # off the floor
    joint, servo = free.joint("left_middle_coxa"), free.actuator("left_middle_coxa").id
    data.qpos[joint.qposadr[0]], data.ctrl[servo] = joint.range
    speeds, forces = [], []
    for _ in range(120):
        mujoco.mj_step(free, data)
        speeds.append(data.qvel[joint.dofadr[0]])
        forces.append(data.actuator_force[servo])
    assert 0.8 * 6.18 < max(speeds) < 6.18
    assert max(forces) == pytest.approx(1.5)
    assert data.qpos[joint.qposadr[0]] == pytest.approx(joint.range[1], abs=0.01)
    assert free.dof_damping[joint.dofadr[0]] * 6.18 == pytest.approx(1.5, rel=0.01)


def test_readers_agree_with_c_from_a_tilted_pose(body, model):
    rng = np.random.default_rng(1)
    there = in_c(body)
    there.qpos[:3] = rng.normal(size=3)
    there.qpos[3:7] = rng.normal(size=4)
    there.qpos[3:7] /= np.linalg.norm(there.qpos[3:7])
    there.qpos[7:] += 0.3 * rng.normal(size=18)
    mujoco.mj_kinematics(body, there)
    data = hexapod.reset(model, jnp.zeros(3)).replace(qpos=jnp.asarray(there.qpos))
    data = jax.jit(mjx.kinematics)(model, data)
    pose = hexapod.pose(data)
    sites = {name: body.site(name).id for name in (*hexapod.EYES, "laser")}
    for i, name in enumerate(hexapod.EYES):
        position, turned = hexapod.eye_poses(pose)
        np.testing.assert_allclose(position[i], there.site_xpos[sites[name]], atol=1e-9)
        np.testing.assert_allclose(turned[i].ravel(), there.site_xmat[sites[name]], atol=1e-9)
    position, turned = hexapod.laser_pose(pose)
    np.testing.assert_allclose(position, there.site_xpos[sites["laser"]], atol=1e-9)
    np.testing.assert_allclose(turned.ravel(), there.site_xmat[sites["laser"]], atol=1e-9)
    forward = turned @ np.array([1.0, 0, 0])
    assert float(hexapod.yaw(pose)) == pytest.approx(np.arctan2(forward[1], forward[0]))
    feet = [body.site(f"{leg}_foot").id for leg in hexapod.LEGS]
    np.testing.assert_allclose(hexapod.feet(data), there.site_xpos[feet], atol=1e-9)
    np.testing.assert_allclose(hexapod.joints(data).ravel(), there.qpos[7:], atol=1e-9)
    pairs = {int(geom) for pair in zip(body.pair_geom1, body.pair_geom2, strict=True) for geom in pair}
    collide = sorted(g for g in pairs if body.geom_bodyid[g] and body.geom(g).name[-4:] != "foot")
    starts, ends, radii = hexapod.capsules(model, data)
    assert len(radii) == len(collide) == 13
    for geom in collide:
        reach = there.geom_xmat[geom].reshape(3, 3) @ [0, 0, body.geom_size[geom, 1]]
        here = [*(there.geom_xpos[geom] - reach), *(there.geom_xpos[geom] + reach), body.geom_size[geom, 0]]
        rows = np.column_stack([starts, ends, radii])
        assert np.abs(rows - here).max(axis=1).min() < 1e-9, body.geom(geom).name


def test_robot_that_is_sick_or_fallen_is_not_sound(model):
    well = hexapod.reset(model, jnp.array([1.0, 2.0, 3.0]))
    assert hexapod.is_sound(well)
    assert not hexapod.is_sound(well.replace(qvel=well.qvel.at[3].set(jnp.nan)))
    assert not hexapod.is_sound(well.replace(qpos=well.qpos.at[20].set(jnp.inf)))
    assert not hexapod.is_sound(well.replace(qpos=well.qpos.at[3:7].set(jnp.array([0.0, 1, 0, 0]))))
    assert not hexapod.is_sound(well.replace(qpos=well.qpos.at[3:7].set(jnp.array([0.8, 0.6, 0, 0]))))
    for height in (0.02, 0.5):
        assert not hexapod.is_sound(well.replace(qpos=well.qpos.at[2].set(height)))


def kinds(tree) -> list:
    """List shape and type of every leaf; the trees themselves hold arrays that have no truth value when compared."""
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def test_a_step_keeps_types_and_shapes_in_either_precision(precision, strict):
    model = hexapod.build()
    data = hexapod.reset(model, jnp.zeros(3))
    assert data.qpos.dtype == precision
    assert kinds(jax.eval_shape(hexapod.reset, model, jnp.zeros(3))) == kinds(data)
    after = jax.eval_shape(hexapod.substep, model, data, jnp.asarray(hexapod.stance(), dtype=float))
    assert kinds(after) == kinds(data)
    scene = room(boxes=boxes(((1.0, 0.5), (0.3, 0.2), 0.4)))
    assert kinds(jax.eval_shape(hexapod.place_obstacles, model, scene, data)) == kinds(model)


def test_nothing_is_tied_to_a_device(model):
    data = hexapod.reset(model, jnp.zeros(3))
    assert not any(leaf.committed for leaf in jax.tree.leaves((model, data)))


def test_bad_robot_files_are_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"none\.xml is none"):
        hexapod.load(tmp_path / "none.xml")
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><geom type='teapot'/></worldbody></mujoco>")
    with pytest.raises(InputError, match="does not compile"):
        hexapod.load(broken)
    cart = tmp_path / "cart.xml"
    cart.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(InputError, match="expected 18 servos"):
        hexapod.load(cart)
    assert hexapod.load(hexapod.xml_path()).nu == 18
    shuffled = tmp_path / "shuffled.xml"
    shuffled.write_text(hexapod.xml_path().read_text().replace("before_bumper", "slot_bumper"))
    with pytest.raises(InputError, match="got slot_bumper for before_bumper"):
        hexapod.build(mujoco.MjModel.from_xml_path(str(shuffled)))
