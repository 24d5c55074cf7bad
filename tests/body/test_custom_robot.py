"""A robot of one's own: its conversion keeps its dynamics, it stands, and every fault in its files is named."""

import re
import tomllib
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from walker import DATA, TIPS, TOML, XML, with_ankles, write

from lgmdjax.body import custom_robot, hexapod, robot_description, robot_xml
from lgmdjax.errors import InputError
from lgmdjax.evaluation import contacts, gait_test
from lgmdjax.locomotion import cpg, gait_fit, kinematics, tripod_gait
from lgmdjax.reporting import robot_shape
from lgmdjax.runtime import storage
from lgmdjax.simulation import assembly
from lgmdjax.transfer import robot_model
from lgmdjax.world import arena

FORWARD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # from the walker's axes, y forward, to ours
HIP_HEIGHT = np.array([0.0, 0.0, 0.03])  # of our origin in its trunk


@pytest.fixture(scope="module")
def walker() -> custom_robot.CustomRobot:
    return custom_robot.read(DATA / "walker.toml")


@pytest.fixture(scope="module")
def theirs() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def ours(walker) -> mujoco.MjModel:
    return hexapod.load(walker.body)


def posed(
    ours: mujoco.MjModel, theirs: mujoco.MjModel, facts, angles: np.ndarray
) -> tuple[mujoco.MjData, mujoco.MjData]:
    """Return both models with our angles, and the joints of theirs that these stand for; both trunks level."""
    one, other = mujoco.MjData(ours), mujoco.MjData(theirs)
    one.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *angles]
    for angle, joint in zip(angles, facts["joints"].values(), strict=True):
        address = theirs.joint(joint["name"]).qposadr[0]
        other.qpos[address] = joint["sign"] * (angle - np.radians(joint["offset_deg"]))
    for model, data in ((ours, one), (theirs, other)):
        mujoco.mj_forward(model, data)
    return one, other


def test_feet_and_inertia_are_those_of_the_users_model(walker, ours, theirs):
    """In a random pose: feet, eyes and scanner, centre of mass, and the inertia that every pair of joints feels."""
    angles = ours.key("stance").qpos[7:] + np.random.default_rng(0).uniform(-0.4, 0.4, 18)
    one, other = posed(ours, theirs, walker.facts, angles)

    def to_ours(points: np.ndarray) -> np.ndarray:
        return (points - other.body("platform").xpos - HIP_HEIGHT) @ FORWARD.T

    feet = [other.geom(name).xpos for name in TIPS]
    np.testing.assert_allclose([one.geom(name).xpos for name in hexapod.FEET], to_ours(np.stack(feet)), atol=2e-6)
    sites = [other.site(name).xpos for name in ("camera_left", "camera_right", "lidar")]
    np.testing.assert_allclose(
        [one.site(name).xpos for name in (*hexapod.EYES, "laser")], to_ours(np.stack(sites)), atol=2e-6
    )
    np.testing.assert_allclose(one.subtree_com[1], to_ours(other.subtree_com[1]), atol=2e-6)
    masses = []
    for model, data in ((ours, one), (theirs, other)):
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        masses.append(full)
    joints = walker.facts["joints"].values()
    order, signs = (
        [theirs.joint(joint["name"]).dofadr[0] for joint in joints],
        np.array([joint["sign"] for joint in joints]),
    )
    expected = masses[1][np.ix_(order, order)] * np.outer(signs, signs)
    np.testing.assert_allclose(masses[0][6:, 6:], expected, atol=1e-6 * expected.max())
    assert masses[0][0, 0] == pytest.approx(theirs.body_subtreemass[1], rel=1e-6)


def test_lengths_limits_and_servos_are_read(walker, ours):
    geometry = kinematics.read_geometry(ours)
    for length, expected in ((geometry.coxa, 0.052), (geometry.femur, 0.9 * 0.066), (geometry.tibia, 1.2 * 0.133)):
        np.testing.assert_allclose(length, expected, rtol=1e-5)
    assert ours.body_mass[1] == pytest.approx(1.3 * 1.522, rel=1e-3)
    limits = np.radians([[-70, 70], [-95, 95], [90 - 190, 90 - 20]] * 6)
    np.testing.assert_allclose(robot_xml.target_limits(walker.body).reshape(2, 18).T, limits, atol=1e-5)
    np.testing.assert_allclose(ours.actuator_forcerange, [[-1.8, 1.8]] * 18)
    assert robot_xml.sensor_mounts(walker.body).eyes[0] == pytest.approx((0.142, 0.036, 0.034))
    assert ours.opt.timestep * 180 == pytest.approx(1, abs=1e-12)


def test_the_package_described_in_a_file_is_the_package(tmp_path):
    """Read from its own MJCF, the package's robot has the numbers of that MJCF."""
    legs = "".join(
        f'[legs.{leg}]\njoints = {[f"{leg}_{joint}" for joint in hexapod.JOINTS]}\nfoot = "{leg}_foot"\n'
        for leg in hexapod.LEGS
    )
    head = f'mjcf = "{hexapod.xml_path()}"\ntrunk = "trunk"\nshape = ["bumper"]\n'
    head += 'eyes = ["eye_left", "eye_right"]\nscanner = "laser"\n'
    (tmp_path / "own.toml").write_text(head + legs)
    found, package = hexapod.load(custom_robot.read(tmp_path / "own.toml").body), hexapod.load()
    exact = (
        "body_mass",
        "site_pos",
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_forcerange",
        "dof_damping",
        "pair_friction",
    )
    for name in (*exact, "body_ipos", "jnt_range", "actuator_ctrlrange", "key_qpos"):
        tolerance = 3e-5 if name == "key_qpos" else 5e-6
        np.testing.assert_allclose(getattr(found, name), getattr(package, name), atol=tolerance, err_msg=name)
    np.testing.assert_allclose(np.sort(found.body_inertia), np.sort(package.body_inertia), atol=1e-7)
    for name in (*hexapod.CAPSULES, *hexapod.FEET):
        np.testing.assert_allclose(found.geom(name).size, package.geom(name).size, atol=1e-6)
        np.testing.assert_allclose(found.geom(name).pos, package.geom(name).pos, atol=1e-6)
    gait = tripod_gait.read_gait(found)
    np.testing.assert_allclose(gait.left_feet, tripod_gait.Gait.left_feet, atol=2e-6)
    assert tripod_gait.read_gait(package) == tripod_gait.Gait()


def test_it_walks_with_a_gait_of_its_own(walker, ours):
    """Half of the fit's usual steps: 0.05 m/s straight on, in C MuJoCo."""
    geometry, gait = kinematics.read_geometry(ours), tripod_gait.read_gait(ours)
    networks = gait_fit.fit(geometry, gait, steps=800, candidates=8)
    targets = gait_test.servo_targets(cpg.Params(), networks, jnp.ones(2), steps=round(8 / gait_test.TIME_STEP))
    trajectory = gait_test.simulate_mujoco(ours, targets)
    measured = gait_test.measure_gait(trajectory, cpg.CYCLE_TIME)
    assert measured.speed == pytest.approx(0.05, rel=0.1)
    assert abs(measured.drift) < np.radians(3)
    foot = trajectory.feet[-144:, 0]  # one cycle of 0.8 s
    lowest, highest = foot[:, 2].min(), foot[:, 2].max()
    assert 0.3 < (highest - lowest) / float(gait.swing_height) < 1.5
    down = foot[:, 2] < lowest + 0.2 * (highest - lowest)
    assert np.all(np.diff(foot[:, 0])[down[1:] & down[:-1]] < 2e-4)  # a foot on the floor goes backward


def test_a_fourth_joint_is_locked_at_its_angle(tmp_path):
    """Bent by 30 degrees, the toe shortens the tibia, by the law of cosines, and turns it."""
    locked = "\n[locked]\n" + "".join(f"{name[:2]}_ankle = 30.0\n" for name in TIPS)
    robot = custom_robot.read(write(tmp_path, TOML + locked, with_ankles(XML)))
    upper, toe, bend = 0.1, 0.0596, np.radians(30)
    straight = np.sqrt(upper**2 + toe**2 + 2 * upper * toe * np.cos(bend))
    assert robot.facts["lengths"]["right_rear"]["tibia"] == pytest.approx(straight, rel=1e-6)
    turned = np.degrees(np.arctan2(toe * np.sin(bend), upper + toe * np.cos(bend)))
    assert robot.facts["joints"]["right_rear_tibia"]["offset_deg"] == pytest.approx(90 - turned, abs=1e-6)
    assert robot.facts["mass"] == pytest.approx(sum(mujoco.MjModel.from_xml_string(XML).body_mass), rel=1e-9)


def test_the_key_frame_says_where_the_feet_stand(tmp_path, theirs):
    """Their heights and places are those of C MuJoCo's kinematics of the user's model."""
    names = [theirs.joint(index).name for index in range(1, theirs.njnt)]
    bent = {"yaw": 0.1, "lift": 0.5, "knee": 2.1}
    joints = [bent[name.split("_")[1]] * (-1 if name in ("R1_yaw", "L3_yaw") else 1) for name in names]
    joints = [0.0 if name in ("L2_yaw", "R2_yaw") else angle for name, angle in zip(names, joints, strict=True)]
    signs = {"L1": 1, "R1": 1, "L3": -1, "R3": -1, "L2": 0, "R2": 0}
    joints = [0.1 * signs[name[:2]] if "yaw" in name else angle for name, angle in zip(names, joints, strict=True)]
    key = f'<keyframe><key name="up" qpos="0 0 0.2 1 0 0 0 {" ".join(map(str, joints))}"/></keyframe></mujoco>'
    robot = custom_robot.read(write(tmp_path, f'stance = "up"\n{TOML}', XML.replace("</mujoco>", key)))
    data = mujoco.MjData(theirs)
    data.qpos[:] = [0, 0, 0.2, 1, 0, 0, 0, *joints]
    mujoco.mj_kinematics(theirs, data)
    feet = (np.stack([data.geom(name).xpos for name in TIPS[:3]]) - [0, 0, 0.2] - HIP_HEIGHT) @ FORWARD.T
    np.testing.assert_allclose(robot.facts["left_feet"], feet[:, :2], atol=1e-5)
    gait = tripod_gait.read_gait(hexapod.load(robot.body))
    assert gait.body_height == pytest.approx(-feet[:, 2].mean(), abs=1e-5)


def test_the_page_shows_the_robot_of_the_tests():
    page = (Path(__file__).parents[2] / "docs" / "howto" / "robot.md").read_text()
    shown = re.search(r"^```toml\n(.*?)^```", page, flags=re.M | re.S)
    assert shown is not None and tomllib.loads(shown[1]) == tomllib.loads(TOML)
    assert set(tomllib.loads(TOML)) <= {*robot_description.FILE.fields, *robot_description.FILE.optional}


def test_all_that_draws_or_measures_a_robot_uses_its_body(walker, ours):
    stance = ours.key("stance").qpos[None]
    drawn = robot_shape.body_geometry(stance, walker.body)
    visible = np.flatnonzero(ours.geom_group == 2)
    assert drawn.starts.shape == (1, len(visible), 3) and len(visible) == 4 + 5 * 6
    np.testing.assert_allclose(drawn.eye_positions[0, 0], [0.142, 0.036, 0.034 + stance[0, 2]], atol=1e-6)
    hull = next(index for index, geom in enumerate(visible) if ours.geom_size[geom, 0] == pytest.approx(0.055))
    np.testing.assert_allclose(
        np.abs(drawn.ends[0, hull] - drawn.starts[0, hull]), [2 * (0.13 - 0.0385), 0, 0], atol=1e-6
    )
    starts, _, radii = contacts.collision_capsules(stance, walker.body)
    own, _, package = contacts.collision_capsules(hexapod.load().key("stance").qpos[None])
    assert radii[1] == pytest.approx(0.014) and package[1] == pytest.approx(0.016)
    assert np.abs(starts[:, 1:] - own[:, 1:]).max() < 0.02
    scanner = assembly.laser_params(walker.body)
    assert scanner.mount == pytest.approx((0.01, 0, 0.035))
    assert scanner.corridor_half_width == pytest.approx(0.15 * walker.facts["left_feet"][1][1] / 0.2, rel=1e-4)
    other = robot_model.build(arena.empty_room(), body=walker.body)
    assert other.body("trunk").mass == pytest.approx(1.979) and other.camera("eye_left_front").pos[2] == pytest.approx(
        0.034
    )


def test_a_run_without_its_body_is_noticed(walker, tmp_path):
    assert robot_xml.read_body(tmp_path) is None
    (tmp_path / robot_xml.FILE).write_text(walker.body.xml)
    assert robot_xml.read_body(tmp_path) == walker.body
    storage.write_stamp(tmp_path, {})
    assert robot_xml.read_body(tmp_path) == walker.body
    (tmp_path / robot_xml.FILE).unlink()
    with pytest.raises(InputError, match=re.escape(robot_xml.FILE)):
        robot_xml.read_body(tmp_path)
