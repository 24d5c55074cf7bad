"""The robot of tests/data/walker.xml, which is built otherwise than the package's, and variants of its files."""

import re
from pathlib import Path

DATA = Path(__file__).parent / "data"
TOML, XML = (DATA / "walker.toml").read_text(), (DATA / "walker.xml").read_text()
TIPS = ("L1_tip", "L2_tip", "L3_tip", "R3_tip", "R2_tip", "R1_tip")  # in the order of `hexapod.LEGS`


def write(folder: Path, toml: str = TOML, xml: str = XML) -> Path:
    """Write both files, and return the path of the description."""
    (folder / "walker.xml").write_text(xml)
    (folder / "walker.toml").write_text(toml)
    return folder / "walker.toml"


def with_ankles(xml: str) -> str:
    """Give every leg a fourth joint, a third of a shank above its tip, whose axis is that of the knee."""
    foot = r'<geom class="drawn" name="(\w\d)_tip" type="sphere" size="0.013" pos="0 0.1596 0"([^>]*)/>'
    ankle = (
        r'<body name="\1_toe" pos="0 0.1 0"><joint name="\1_ankle" axis="-1 0 0" range="-60 60"/>'
        r'<geom class="drawn" name="\1_tip" type="sphere" size="0.013" pos="0 0.0596 0"\2/></body>'
    )
    return re.sub(foot, ankle, xml)
