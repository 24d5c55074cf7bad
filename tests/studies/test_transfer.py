"""Study transfer: which rows there are, and that an interrupted study goes on where it was; walks are synthetic."""

from pathlib import Path

import jax
import numpy as np
import pytest
import synthetic

from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.simulation import recording
from lgmdjax.studies import transfer
from lgmdjax.studies.settings import TransferSettings
from lgmdjax.transfer import walk

SETTINGS = TransferSettings(scale="smoke", scenes=("indoor",), faults=("jpeg", "rate"))


def test_every_fault_is_a_row_and_teacher_and_blind_stand_beside():
    rows = list(transfer.plan(SETTINGS))
    unseen = [(row.world, row.policy) for row in rows if row.trial == "unseen"]
    compared = [(world, policy) for world in ("own", "other", "together") for policy in ("learned", "teacher", "blind")]
    assert sorted(unseen) == sorted([*compared, *((world, "learned") for world in ("prisms", "jpeg", "rate"))])
    assert sum(row.trial == "indoor" for row in rows) == 6
    assert all((row.style is None) == (row.world == "own") for row in rows)
    assert next(row for row in rows if row.world == "together").faults == ("jpeg", "rate")


@pytest.mark.usefixtures("float32")
def test_an_interrupted_study_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    walked = []

    def synthetic_walk(robot, rooms, seconds, policy, world, label=""):
        walked.append(label)
        if len(walked) == 4:
            raise KeyboardInterrupt
        return jax.tree.map(np.float32, synthetic.walk(robots=len(rooms.starts), frames=60)).replace(
            **{name: getattr(synthetic.walk(frames=60), name) for name in ("contact", "is_first", "ok", "resets")}
        )

    def synthetic_record(folder, robot, rooms, *_, **__):
        return synthetic.walk(robots=len(rooms.starts), frames=60)

    monkeypatch.setattr(walk, "walk", synthetic_walk)
    monkeypatch.setattr(recording, "record_rollouts", synthetic_record)
    inputs = {"fit-gait": PRETRAINED_DIR, "train": PRETRAINED_DIR}
    with pytest.raises(KeyboardInterrupt):
        transfer.run(tmp_path, inputs, SETTINGS, 0)
    transfer.run(tmp_path, inputs, SETTINGS, 0)
    assert len(walked) == len(set(walked)) + 1  # none but the interrupted one is walked again
    rows = storage.read_table(tmp_path / "transfer.json")
    assert len(rows) == len(list(transfer.plan(SETTINGS)))
    assert style.to_png(transfer.plot(rows)).startswith(b"\x89PNG")
