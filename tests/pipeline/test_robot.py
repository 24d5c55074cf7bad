"""A run of a robot of one's own: named after it, resumed with it alone, and its body goes from stage to stage."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_rooms import box_ahead, with_mirror_images
from walker import DATA, TOML, write

from lgmdjax.body import custom_robot, hexapod, robot_xml
from lgmdjax.cli import main
from lgmdjax.control import braitenberg, policies
from lgmdjax.evaluation import gait_test
from lgmdjax.locomotion import cpg, gait_fit, kinematics, shaping, tripod_gait
from lgmdjax.pipeline import fit_gait, robot
from lgmdjax.reporting import walk_scene
from lgmdjax.runtime import run_folders, storage
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, rollout

pytestmark = pytest.mark.optimised
CAMERA = CameraSettings(width=16, height=12)


@pytest.fixture(scope="module")
def walker() -> custom_robot.CustomRobot:
    return custom_robot.read(DATA / "walker.toml")


def test_a_run_is_named_after_its_robot_and_needs_it(walker, tmp_path, monkeypatch, capsys):
    executed = []
    monkeypatch.setattr(
        "lgmdjax.runtime.run_folders.execute", lambda run, stages, target: executed.append((run, stages))
    )
    command = ["train", "--scale", "smoke", "--out", str(tmp_path), "--name", "mine"]
    assert main.main([*command[:-2], "--robot", str(DATA / "walker.toml")]) == 0
    ((run, stages),) = executed
    assert run.folder.name == "smoke-0_robot=walker"
    settings = storage.read_json(run.folder / "run.json")["settings"]
    assert settings["robot"] == {"name": "walker", "digest": walker.digest}
    assert [stage.name for stage in stages[:2]] == ["robot", "fit-gait"] and stages[1].inputs == ("robot",)
    assert main.main([*command, "--robot", str(DATA / "walker.toml")]) == 0
    for given in (
        [],
        ["--robot", str(write(tmp_path, TOML.replace("[legs.left_front]", "# Changed.\n[legs.left_front]")))],
    ):
        capsys.readouterr()
        assert main.main([*command, *given]) == 2
        line = capsys.readouterr().err
        assert "settings.robot" in line and walker.digest in line and line.count("\n") == 1
    assert main.main([*command, "--robot", "none.toml"]) == 2
    assert "expected the TOML file of a robot, found none at none.toml" in capsys.readouterr().err


def test_the_body_goes_from_stage_to_stage(walker, tmp_path):
    """From the stage that writes it to the robot that is assembled from the gait's folder."""
    stages = [robot.make_stage(walker), run_folders.Stage(name="fit-gait", run=_write_gait, inputs=("robot",))]
    settings = {"robot": robot.settings_of(walker), "fit-gait": {}}
    gait = run_folders.execute(run_folders.open_run(tmp_path, "run", "smoke", 0, settings), stages, "fit-gait")
    assert storage.read_json(tmp_path / "run" / "robot" / "robot.json")["mass"] == pytest.approx(3.673, abs=1e-3)
    assembled = assembly.assemble_robot(gait, CAMERA, _detector(), assembly.make_policies())
    assert assembled.body == walker.body == robot_xml.find_body(gait / "walks")
    assert assembled.camera.mounts == robot_xml.sensor_mounts(walker.body).eyes
    wider = assembly.with_camera(assembled, replace(CAMERA, width=32))
    assert wider.camera.mounts == assembled.camera.mounts and wider.camera.width == 32
    package = assembly.assemble_robot(assembly.PRETRAINED_DIR, CAMERA, _detector(), assembly.make_policies())
    assert package.body is None and package.camera.mounts is None
    assert assembly.fingerprint(assembled) != assembly.fingerprint(replace(assembled, body=None))
    model = closed_loop.build_model(assembled)
    data = hexapod.init(model, jnp.zeros(3))
    np.testing.assert_allclose(data.qpos[2], walker.facts["height"], atol=1e-5)
    assert bool(hexapod.is_healthy(model, data)) and not bool(
        hexapod.is_healthy(model, data.replace(qpos=data.qpos.at[2].set(0.045)))
    )


def _write_gait(folder: Path, inputs, settings, seed: int) -> None:
    assert fit_gait._take_body(folder, inputs) is not None
    shaping.save(folder / "shaping.safetensors", shaping.load_pretrained())


def _detector():
    return assembly.lgmd_params({"threshold": 1.0, "suppression": 9.0, "inhibition": 0.3})


@pytest.mark.skipif(not walk_scene.HAS_VISER, reason="needs the extra viewer")
def test_the_viewer_draws_the_body_of_the_walk(walker):
    server = walk_scene.quiet_server("127.0.0.1", 0)
    try:
        scene = walk_scene.WalkScene(server)
        before = scene.model
        scene.set_body(None)
        assert scene.model is before
        scene.set_body(walker.body)
        assert scene.model.body("trunk").mass == pytest.approx(1.979)
        scene.show(scene.model.key("stance").qpos, np.zeros((0, 2)))
    finally:
        server.stop()


@pytest.mark.extended
@pytest.mark.slow
@pytest.mark.usefixtures("float32")
def test_it_walks_in_mjx_and_its_teacher_avoids_a_box(walker):
    """Speed and heading in MJX are those in C MuJoCo; then it walks around a box 1 m ahead, and around its image."""
    body = hexapod.load(walker.body)
    networks = gait_fit.fit(kinematics.read_geometry(body), tripod_gait.read_gait(body), steps=3000)
    targets = gait_test.servo_targets(cpg.Params(), networks, jnp.ones(2), steps=round(8 / gait_test.TIME_STEP))
    walks = gait_test.simulate_mjx(hexapod.build(body), targets[None])[0], gait_test.simulate_mujoco(body, targets)
    mjx, c = (gait_test.measure_gait(walk, cpg.CYCLE_TIME) for walk in walks)
    assert mjx.speed == pytest.approx(0.05, rel=0.05) and mjx.speed == pytest.approx(c.speed, rel=0.01)
    assert abs(mjx.drift) < np.radians(2) and abs(c.drift) < np.radians(2)
    teacher = braitenberg.Params()
    params = assembly.assemble(
        teacher,
        shaping_params=networks,
        camera_params=assembly.camera_params(CAMERA, walker.body),
        laser_params=assembly.laser_params(walker.body),
    )
    params = replace(params, body=walker.body)
    rooms = with_mirror_images([box_ahead(jax.random.key(0), 0.05)])
    model = closed_loop.build_model(params)
    record = rollout.concatenate_time(
        list(rollout.rollout_chunks(params, model, rooms, policies.TEACHER, 25.0, render=False))
    )
    assert record.ok.all() and not record.contact.any() and record.clearance.min() > 0.02
    travelled = np.linalg.norm(record.position[:, -1, :2] - record.position[:, 0, :2], axis=1)
    assert np.all(travelled > 1.2) and np.all(np.abs(record.position[:, :, 1]).max(axis=1) > 0.3)
