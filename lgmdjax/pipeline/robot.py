"""Stage robot: the body of a robot of one's own (`lgmdjax.body.custom_robot`), in runs that have one.

Writes robot.xml, the body in the form of `mjcf/hexapod.xml`, and robot.json, what was read about it.
"""

from collections.abc import Mapping
from pathlib import Path

from lgmdjax.body import robot_xml
from lgmdjax.body.custom_robot import CustomRobot
from lgmdjax.pipeline.settings import RobotSettings
from lgmdjax.runtime import partial_files
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.runtime.storage import write_json


def make_stage(robot: CustomRobot) -> Stage:
    """Return the stage that writes the files of a robot."""

    def run(folder: Path, inputs: Mapping[str, Path], settings: RobotSettings, seed: int) -> None:
        with partial_files.replacing(folder / robot_xml.FILE) as partial:
            partial.write_text(robot.body.xml, encoding="utf-8")
        write_json(folder / "robot.json", robot.facts)
        lengths = robot.facts["lengths"]["left_front"]
        print(
            f"robot: {robot.name}, {robot.facts['mass']:.2f} kg, trunk {1e3 * robot.facts['height']:.0f} mm high; "
            + ", ".join(f"{part} {1e3 * length:.0f} mm" for part, length in lengths.items()),
            flush=True,
        )

    return Stage(name="robot", run=run)


def settings_of(robot: CustomRobot) -> RobotSettings:
    """Return the settings of the stage."""
    return RobotSettings(name=robot.name, digest=robot.digest)
