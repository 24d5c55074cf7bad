"""Recorded walks as files that are shown without JAX, and the one that comes with the package."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest
import synthetic

from lgmdjax.body import robot_xml
from lgmdjax.errors import InputError
from lgmdjax.paths import DATA_DIR
from lgmdjax.reporting import playback, walk_page
from lgmdjax.reporting.playback import Playback

FRAMES = 45


@pytest.fixture(scope="module")
def walk() -> Playback:
    generator = np.random.default_rng(0)
    record = synthetic.walk(1, FRAMES)
    contact, is_first = np.zeros(FRAMES, bool), np.zeros(FRAMES, bool)
    contact[[10, 11, 30]], is_first[[0, 12]] = True, True
    time, rows, columns = np.arange(FRAMES)[:, None, None, None], np.arange(60)[:, None], np.arange(80)
    grating = 127 + 100 * np.sin(columns / 9 + rows / 13 + time / 20 + np.arange(2)[:, None, None])
    shown = walk_page.to_playback(synthetic_one(record), synthetic.room())
    return shown._replace(
        contact=contact,
        is_first=is_first,
        pictures=grating.astype(np.uint8),
        layers=generator.integers(0, 255, (FRAMES, 2, 3, 10, 14)).astype(np.uint8),
    )


def synthetic_one(record):
    return type(record)(**{name: value[0] for name, value in vars(record).items()})


def test_a_file_holds_numbers_and_layers_exactly_and_pictures_nearly(walk, tmp_path):
    playback.save(tmp_path / "walk.npz", walk)
    read = playback.load(tmp_path / "walk.npz")
    for name in ("time", "qpos", "u", "velocity", "contact", "is_first", "centres"):
        np.testing.assert_array_equal(getattr(read, name), getattr(walk, name).astype(getattr(read, name).dtype))
    for name, value in read.room._asdict().items():
        np.testing.assert_allclose(value, getattr(walk.room, name), rtol=1e-6)
    np.testing.assert_array_equal(read.layers, walk.layers)
    assert read.pictures is not None
    assert np.abs(read.pictures.astype(int) - walk.pictures).mean() < 4
    assert read.title == walk.title


def test_a_damaged_or_another_file_is_one_line(walk, tmp_path):
    path = tmp_path / "walk.npz"
    playback.save(path, walk)
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    whole = path.read_bytes()
    for content in (b"", whole[:-100], whole[:2000] + b"x" + whole[2001:], (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"^[^\n]*expected [^\n]*$"):
            playback.load(path)
    with pytest.raises(InputError, match="without; simulate it live"):
        playback.save(tmp_path / "blind.npz", walk._replace(pictures=None))
    assert not (tmp_path / "blind.npz").exists()


def test_contacts_and_paths_begin_where_the_record_says(walk):
    assert playback.contacts_of(walk) == [10, 30]
    assert [len(path) for path in playback.path_of(walk)] == [12, FRAMES - 12]


def test_the_walk_of_the_package_is_one_of_this_robot():
    path = DATA_DIR / "demo.npz"
    assert path.stat().st_size < 1e6
    demo = playback.load(path)
    assert demo.pictures is not None and demo.layers is not None
    np.testing.assert_allclose(np.diff(demo.time), 1 / 30, atol=1e-4)
    limits = robot_xml.load().jnt_range[1:]
    assert np.all((demo.qpos[:, 7:] > limits[:, 0] - 0.1) & (demo.qpos[:, 7:] < limits[:, 1] + 0.1))
    assert np.all((demo.u >= 0.5) & (demo.u <= 1)) and np.ptp(demo.u) > 0.02
    low, high = demo.room.bounds[0::2], demo.room.bounds[1::2]
    assert np.all((demo.qpos[:, :2] > low) & (demo.qpos[:, :2] < high))
    # Its feet stand on the floor: of the six, three or more are within a centimetre of it in nearly every frame.
    model = robot_xml.load()
    data = mujoco.MjData(model)
    feet = [model.geom(f"{leg}_foot").id for leg in robot_xml.LEGS]
    down = []
    for qpos in demo.qpos[::20]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        down.append(int(np.sum(data.geom_xpos[feet, 2] - model.geom_size[feet, 0] < 0.01)))
    assert np.mean(np.array(down) >= 3) > 0.9


def test_to_show_a_walk_loads_no_jax():
    program = "import sys, lgmdjax.cli.view; print('jax' in sys.modules, 'matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
