"""The robot stands, obstacles stop it, and its physics equals that of C MuJoCo."""

from dataclasses import replace
from functools import partial
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

pytestmark = pytest.mark.optimised

STEPS = 18  # 0.1 s, of one call of `run`
ROBOTS = 6
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
    """Compile a function that simulates ROBOTS robots for STEPS, each in its own room."""

    def run_one(model, room, data, targets):
        placed = hexapod.place_barriers(model, room, data)

        def step(data, angles):
            data = hexapod.substep(placed, data, angles)
            return data, jnp.min(arena.clearance(room, *hexapod.capsules(placed, data)))

        return jax.lax.scan(step, data, targets)

    return jax.jit(jax.vmap(run_one, in_axes=(None, 0, 0, 0)))


def stacked(rooms):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)


def standing(model, starts) -> mjx.Data:
    return jax.vmap(lambda start: hexapod.init(model, start))(jnp.asarray(starts, dtype=float))


def boxes(*rows) -> arena.Prisms:
    centre, half_size, yaw = (list(column) for column in zip(*rows, strict=True))
    return arena.make_prisms(jnp.asarray(centre), jnp.asarray(half_size), 0.4, yaw=jnp.asarray(yaw), capacity=3)


def cylinders(*rows) -> arena.Prisms:
    centre, radius = (list(column) for column in zip(*rows, strict=True))
    return arena.make_prisms(jnp.asarray(centre), jnp.asarray(radius)[:, None], 0.4, capacity=3)


def room(boxes: arena.Prisms | None = None, cylinders: arena.Prisms | None = None) -> arena.Arena:
    return arena.empty_room((12.0, 12.0), boxes=boxes or arena.inactive(3), cylinders=cylinders or arena.inactive(3))


def stance_data(body: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(body)
    mujoco.mj_resetDataKeyframe(body, data, body.key("stance").id)
    return data


def test_lengths_masses_and_limits_match_the_data_sheets(body):
    geometry = kinematics.read_geometry(body)
    lengths = np.array([geometry.coxa, geometry.femur, geometry.tibia])
    np.testing.assert_allclose(lengths, [0.052, 0.066, 0.133], atol=1e-9)
    np.testing.assert_allclose(geometry.mounts[:, :2], reference.MOUNTS, atol=1e-9)
    np.testing.assert_allclose(geometry.mount_yaws, reference.MOUNT_YAWS, atol=1e-9)
    masses = [1.522, *[0.0247, 0.0858, 0.1718] * 6]
    np.testing.assert_allclose(body.body_mass[1:], masses, rtol=1e-6)
    assert body.body_inertia[1].max() < 0.02  # of a 1.5 kg trunk of 0.3 m; published models have 3 to 6
    limits = np.radians([[-75, 75], [-100, 100], [-102, 67]] * 6)
    np.testing.assert_allclose(body.jnt_range[1:], limits, atol=1e-9)
    np.testing.assert_allclose(body.actuator_ctrlrange, limits, atol=1e-9)
    np.testing.assert_allclose(body.actuator_forcerange, [[-1.5, 1.5]] * 18)
    assert body.opt.timestep * 6 * 30 == pytest.approx(1, abs=1e-12)


def test_eyes_are_6_5_cm_apart_and_laser_is_3_cm_above_the_centre(body):
    pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.array([1.0, 0, 0, 0]))
    eyes, rotations = hexapod.eye_poses(pose)
    np.testing.assert_allclose(eyes[0] - eyes[1], [0, 0.065, 0], atol=1e-9)
    np.testing.assert_allclose(rotations, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(hexapod.laser_pose(pose)[0], [0, 0, 0.03], atol=1e-9)
    bumper = body.geom("bumper")
    nose = bumper.pos[0] + bumper.size[1] + np.sqrt(bumper.size[0] ** 2 - eyes[0, 1] ** 2)
    assert eyes[0, 0] < nose  # contact with a wall comes before an eye passes through it


def test_default_stance_is_that_of_the_gait_with_the_papers_width(body):
    feet = np.asarray(kinematics.forward(kinematics.read_geometry(body), jnp.asarray(hexapod.stance())))
    np.testing.assert_allclose(feet, tripod_gait.neutral_feet(tripod_gait.Gait()), atol=1e-5)
    length, width = np.ptp(feet[:, :2], axis=0)
    assert width == pytest.approx(0.40, rel=0.1)
    # The paper has about 0.45; the feet of this gait are closer together, for less sway (`tripod_gait.Gait`).
    assert 0.30 < length < 0.45
    data = stance_data(body)
    mujoco.mj_kinematics(body, data)
    is_visible = body.geom_group == 2
    reach = np.abs(data.geom_xpos[is_visible, :2]).max(axis=0) + body.geom_size[is_visible, 0].max()
    assert np.all(reach < 0.25)  # with its knees it fits the paper's half metre


def test_stands_ten_seconds_in_c(body):
    data = stance_data(body)
    for _ in range(1800):
        mujoco.mj_step(body, data)
    assert np.linalg.norm(data.qpos[:2]) < 0.005
    assert abs(data.qpos[2] - body.key("stance").qpos[2]) < 0.005
    assert abs(data.qpos[3]) > np.cos(np.radians(0.5) / 2)


@pytest.mark.slow
def test_stands_ten_seconds_in_mjx(model, run):
    starts = np.array([[0.3 * i, -0.2 * i, 0.7 * i] for i in range(ROBOTS)])
    data = standing(model, starts)
    targets = jnp.broadcast_to(jnp.asarray(hexapod.stance()), (ROBOTS, STEPS, 6, 3))
    rooms = stacked([room()] * ROBOTS)
    first = data.qpos
    for _ in range(100):
        data, _ = run(model, rooms, data, targets)
    assert np.linalg.norm(data.qpos[:, :2] - starts[:, :2], axis=1).max() < 0.005
    assert np.abs(data.qpos[:, 2] - first[:, 2]).max() < 0.005
    yaw_change = jax.vmap(lambda data: hexapod.yaw(hexapod.pose(data)))(data) - starts[:, 2]
    assert np.abs((yaw_change + np.pi) % (2 * np.pi) - np.pi).max() < np.radians(0.5)
    assert np.all(jax.vmap(partial(hexapod.is_healthy, model))(data))


def rooms_in_contact(body: mujoco.MjModel) -> list[arena.Arena]:
    """Build rooms whose obstacles overlap the standing robot by 4 mm; the first room has none."""
    data = stance_data(body)
    mujoco.mj_kinematics(body, data)
    front, middle, _, rear = (data.body(f"{leg}_tibia").xpos[:2] for leg in hexapod.LEGS[:4])
    knee = body.geom("left_front_femur").size[0] - 0.004
    nose = np.array([body.geom("bumper").size[:2].sum() - 0.004, 0.0])

    def offset(point, direction, radius):
        direction = np.radians(direction)
        return point + radius * np.array([np.cos(direction), np.sin(direction)])

    wall = boxes((offset(front, 0, 0.2 + knee), (0.2, 2.0), 0.0))
    corner = boxes((offset(middle, 90, 0.1 * np.sqrt(2) + knee), (0.1, 0.1), np.pi / 4))
    pole = cylinders((offset(nose, 0, 0.1), 0.1))
    poles = cylinders((offset(front, 50, 0.1 + knee), 0.1), (offset(rear, -120, 0.08 + knee), 0.08))
    behind = boxes((offset(rear, 180, 0.2 + knee), (0.2, 2.0), 0.0))
    single = [room(boxes=wall), room(boxes=corner), room(cylinders=pole), room(cylinders=poles)]
    return [room(), *single, room(boxes=behind, cylinders=pole)]


def test_mjx_equals_c_mujoco_from_random_velocities(body, model, run):
    data = standing(model, np.zeros((ROBOTS, 3)))
    velocities = 0.3 * np.random.default_rng(0).normal(size=(ROBOTS, model.nv))
    data = data.replace(qvel=jnp.asarray(velocities))
    targets = jnp.broadcast_to(jnp.asarray(hexapod.stance()), (ROBOTS, STEPS, 6, 3))
    rooms = rooms_in_contact(body)
    # A tighter tolerance than walking needs, since accelerations are compared too.
    tight = model.replace(opt=model.opt.replace(tolerance=jnp.full_like(model.opt.tolerance, 1e-10)))
    after, _ = run(tight, stacked(rooms), data, targets)
    for robot, scene in enumerate(rooms):
        placed = hexapod.place_barriers(model, scene, jax.tree.map(lambda x: x[0], data))
        model_c = reference.with_barriers(hexapod.load(), placed)
        model_c.opt.tolerance = 1e-10
        data_c = stance_data(model_c)
        data_c.qvel[:] = velocities[robot]
        contacts = 0
        for _ in range(STEPS):
            mujoco.mj_step(model_c, data_c)
            contacts += np.sum((data_c.contact.dim == 1) & (data_c.contact.dist < 0))
        assert (contacts > 0) == (robot > 0)  # all but the first are in contact
        for field in MOTION + FORCES:
            ours = np.asarray(getattr(after, field)[robot]).reshape(np.shape(getattr(data_c, field)))
            np.testing.assert_allclose(ours, getattr(data_c, field), atol=1e-4, err_msg=f"{field}, robot {robot}")


NEUTRAL_FEET = reference.MOUNTS + 0.1 * np.stack([np.cos(reference.MOUNT_YAWS), np.sin(reference.MOUNT_YAWS)], axis=-1)
# Nothing; a wall, the corner of a box or a cylinder ahead; a cylinder or a box in front of the left front leg only.
ROOMS_AHEAD = (
    room(),
    room(boxes=boxes(((0.5, 0.0), (0.2, 2.0), 0.1))),
    room(boxes=boxes(((0.36, 0.0), (0.1, 0.1), np.pi / 4))),
    room(cylinders=cylinders(((0.32, 0.0), 0.1))),
    room(cylinders=cylinders(((0.33, 0.18), 0.08))),
    room(boxes=boxes(((0.36, 0.23), (0.1, 0.1), 0.0))),
)


def test_obstacles_stop_trunk_and_legs(model, run):
    """Three seconds at 0.1 m/s against obstacles: the capsules penetrate no deeper than soft contacts allow."""
    feet = np.column_stack([NEUTRAL_FEET, np.full(6, -0.1)])
    targets = reference.tripod(540, (0.1, 0.1), feet).reshape(30, STEPS, 6, 3)
    rooms = stacked(ROOMS_AHEAD)
    start = jnp.zeros(3)
    data = jax.vmap(lambda _: hexapod.init(model, start, jnp.asarray(targets[0, 0])))(jnp.arange(ROBOTS))
    clearances = []
    for rows in targets:
        data, clearance = run(model, rooms, data, jnp.broadcast_to(jnp.asarray(rows), (ROBOTS, STEPS, 6, 3)))
        clearances.append(clearance)
    min_clearance = np.concatenate(clearances, axis=1).min(axis=1)
    assert np.all(jax.vmap(partial(hexapod.is_healthy, model))(data))
    assert data.qpos[0, 0] > 0.25  # the first walks freely
    assert np.all(np.asarray(data.qpos[1:4, 0]) < 0.17)  # those with an obstacle ahead of the trunk are stopped
    assert np.all(min_clearance[1:] < 0.002)  # all come into contact
    assert np.all(min_clearance[1:] > -0.012)  # and penetrate no deeper than soft contacts allow
    yaws = jax.vmap(lambda data: hexapod.yaw(hexapod.pose(data)))(data)
    assert np.abs(yaws[4:]).min() > 0.03  # a robot held at one leg turns
    assert np.abs(yaws[0]) < 0.01


def barrier(placed: mjx.Model, capsule: str) -> tuple[np.ndarray, float]:
    """Return the normal of a capsule's barrier and its distance from the origin, computed with SciPy."""
    index = hexapod.load().geom(f"before_{capsule}").id
    quaternion = np.asarray(placed.geom_quat[index])
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-6)
    normal = Rotation.from_quat(quaternion, scalar_first=True).apply([0.0, 0.0, 1.0])
    return normal, float(normal @ np.asarray(placed.geom_pos[index]))


def test_barriers_touch_the_nearest_obstacle_and_ignore_overhead_ones(model):
    scene = room(
        boxes=boxes(((1.0, 0.0), (0.3, 0.5), 0.0)),
        cylinders=arena.make_prisms(
            [[0.0, 0.5], [0.4, 0.0]], [[0.1], [0.5]], [0.4, 1.0], bottom=[0.0, 0.5], capacity=3
        ),
    )
    placed = hexapod.place_barriers(model, scene, hexapod.init(model, jnp.zeros(3)))
    normal, offset = barrier(placed, "left_middle_tibia")
    np.testing.assert_allclose(normal, [0.0, -1.0, 0.0], atol=1e-6)
    assert offset == pytest.approx(-0.4)
    normal, offset = barrier(placed, "right_front_tibia")
    np.testing.assert_allclose(normal, [-1.0, 0.0, 0.0], atol=1e-6)
    assert offset == pytest.approx(-0.7)


def test_each_capsule_is_as_far_from_its_barrier_as_from_the_nearest_obstacle(model):
    """Around a robot that faces backward, with obstacles at its left front, right rear and left middle leg."""
    obstacles = cylinders(((0.30, 0.25), 0.05), ((-0.28, -0.25), 0.05), ((0.0, 0.45), 0.05))
    scene = room(cylinders=replace(obstacles, centre=0.5 - obstacles.centre))
    data = hexapod.init(model, jnp.asarray([0.5, 0.5, jnp.pi]))
    placed = jax.jit(hexapod.place_barriers)(model, scene, data)
    capsules = hexapod.capsules(model, jax.jit(mjx.kinematics)(model, data))
    clearance = np.asarray(arena.clearance(scene, *capsules))
    starts, ends, radii = map(np.asarray, capsules)
    for k, capsule in enumerate(hexapod.CAPSULES):
        normal, offset = barrier(placed, capsule)
        assert min(normal @ starts[k], normal @ ends[k]) - offset - radii[k] == pytest.approx(clearance[k], abs=1e-6)
    for capsule, row in {"left_front_tibia": 0, "right_rear_tibia": 1, "left_middle_tibia": 2}.items():
        normal, offset = barrier(placed, capsule)
        assert normal[:2] @ np.asarray(scene.cylinders.centre[row]) + 0.05 == pytest.approx(offset, abs=1e-6), capsule


def test_speed_and_torque_of_servos_do_not_exceed_those_of_the_ax_12a(body):
    free = mujoco.MjModel.from_xml_path(str(hexapod.xml_path()))
    free.opt.gravity[:] = 0
    data = stance_data(free)
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


def test_poses_and_positions_equal_those_of_c_mujoco(body, model):
    rng = np.random.default_rng(1)
    data_c = stance_data(body)
    data_c.qpos[:3] = rng.normal(size=3)
    data_c.qpos[3:7] = rng.normal(size=4)
    data_c.qpos[3:7] /= np.linalg.norm(data_c.qpos[3:7])
    data_c.qpos[7:] += 0.3 * rng.normal(size=18)
    mujoco.mj_kinematics(body, data_c)
    data = hexapod.init(model, jnp.zeros(3)).replace(qpos=jnp.asarray(data_c.qpos))
    data = jax.jit(mjx.kinematics)(model, data)
    pose = hexapod.pose(data)
    sites = {name: body.site(name).id for name in (*hexapod.EYES, "laser")}
    for i, name in enumerate(hexapod.EYES):
        position, rotation = hexapod.eye_poses(pose)
        np.testing.assert_allclose(position[i], data_c.site_xpos[sites[name]], atol=1e-9)
        np.testing.assert_allclose(rotation[i].ravel(), data_c.site_xmat[sites[name]], atol=1e-9)
    position, rotation = hexapod.laser_pose(pose)
    np.testing.assert_allclose(position, data_c.site_xpos[sites["laser"]], atol=1e-9)
    np.testing.assert_allclose(rotation.ravel(), data_c.site_xmat[sites["laser"]], atol=1e-9)
    forward = rotation @ np.array([1.0, 0, 0])
    assert float(hexapod.yaw(pose)) == pytest.approx(np.arctan2(forward[1], forward[0]))
    feet = [body.site(f"{leg}_foot").id for leg in hexapod.LEGS]
    np.testing.assert_allclose(hexapod.foot_positions(model, data), data_c.site_xpos[feet], atol=1e-9)
    np.testing.assert_allclose(hexapod.joint_angles(data).ravel(), data_c.qpos[7:], atol=1e-9)
    pairs = {int(geom) for pair in zip(body.pair_geom1, body.pair_geom2, strict=True) for geom in pair}
    colliding = sorted(g for g in pairs if body.geom_bodyid[g] and body.geom(g).name[-4:] != "foot")
    starts, ends, radii = hexapod.capsules(model, data)
    assert len(radii) == len(colliding) == 13
    for geom in colliding:
        reach = data_c.geom_xmat[geom].reshape(3, 3) @ [0, 0, body.geom_size[geom, 1]]
        expected = [*(data_c.geom_xpos[geom] - reach), *(data_c.geom_xpos[geom] + reach), body.geom_size[geom, 0]]
        rows = np.column_stack([starts, ends, radii])
        assert np.abs(rows - expected).max(axis=1).min() < 1e-9, body.geom(geom).name


def test_fallen_or_non_finite_robot_is_not_healthy(model):
    data = hexapod.init(model, jnp.array([1.0, 2.0, 3.0]))
    assert hexapod.is_healthy(model, data)
    assert not hexapod.is_healthy(model, data.replace(qvel=data.qvel.at[3].set(jnp.nan)))
    assert not hexapod.is_healthy(model, data.replace(qpos=data.qpos.at[20].set(jnp.inf)))
    assert not hexapod.is_healthy(model, data.replace(qpos=data.qpos.at[3:7].set(jnp.array([0.0, 1, 0, 0]))))
    assert not hexapod.is_healthy(model, data.replace(qpos=data.qpos.at[3:7].set(jnp.array([0.8, 0.6, 0, 0]))))
    for height in (0.02, 0.5):
        assert not hexapod.is_healthy(model, data.replace(qpos=data.qpos.at[2].set(height)))


def shapes_and_dtypes(tree) -> list:
    """Return shape and dtype of every leaf."""
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def test_a_step_preserves_dtypes_and_shapes_in_both_precisions(precision, strict):
    model = hexapod.build()
    data = hexapod.init(model, jnp.zeros(3))
    assert data.qpos.dtype == precision
    assert shapes_and_dtypes(jax.eval_shape(hexapod.init, model, jnp.zeros(3))) == shapes_and_dtypes(data)
    after = jax.eval_shape(hexapod.substep, model, data, jnp.asarray(hexapod.stance(), dtype=float))
    assert shapes_and_dtypes(after) == shapes_and_dtypes(data)
    scene = room(boxes=boxes(((1.0, 0.5), (0.3, 0.2), 0.4)))
    assert shapes_and_dtypes(jax.eval_shape(hexapod.place_barriers, model, scene, data)) == shapes_and_dtypes(model)


def test_no_array_is_committed_to_a_device(model):
    data = hexapod.init(model, jnp.zeros(3))
    assert not any(leaf.committed for leaf in jax.tree.leaves((model, data)))


def test_invalid_robot_files_are_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"none\.xml, which does not exist"):
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
    with pytest.raises(InputError, match=r"expected a geom before_bumper, as in .*, got none"):
        hexapod.build(mujoco.MjModel.from_xml_path(str(shuffled)))
