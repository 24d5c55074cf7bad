"""Every fault in the files of a robot of one's own is named in one line that says what to do."""

import re

import pytest
from walker import TOML, XML, with_ankles, write

from lgmdjax.body import custom_robot
from lgmdjax.errors import InputError

# File, text in it, what replaces it, and a part of the message.
FAULTS = {
    "no eyes": (
        "toml",
        'eyes = ["camera_left", "camera_right"]\n',
        "",
        "expected an object with mjcf, trunk, shape, eyes",
    ),
    "unknown key": ("toml", "scanner =", "scaner =", "expected an object with"),
    "further key": ("toml", "scanner =", 'colour = "red"\nscanner =', "expected no key colour, got one"),
    "wrong trunk": (
        "toml",
        '"platform"',
        '"platfrom"',
        "expected the name of a body of walker.xml, got 'platfrom'; did you mean",
    ),
    "no file": ("toml", "walker.xml", "runner.xml", "mjcf: expected the path of an MJCF"),
    "wrong order": (
        "toml",
        '"L1_yaw", "L1_lift"',
        '"L1_lift", "L1_yaw"',
        "legs.left_front.joints: expected L1_yaw in a body of its own",
    ),
    "other leg": ("toml", '"L1_knee"', '"R1_knee"', "expected R1_knee in a body of its own below L1_thigh"),
    "joint twice": (
        "toml",
        '"L1_yaw", "L1_lift", "L1_knee"',
        '"L2_yaw", "L2_lift", "L2_knee"',
        "expected a foot on the body of L2_knee",
    ),
    "no sphere": (
        "toml",
        '"L1_tip"',
        '"L1_shank"',
        "legs.left_front.foot: expected a sphere, got L1_shank of another shape",
    ),
    "other axis": (
        "toml",
        'forward = "y"\n',
        "",
        "legs.left_middle: expected a leg on the left of the trunk, got one 0 mm to its right; exchange",
    ),
    "leg as shape": ("toml", '"face"]', '"L1_shank"]', "shape: expected geoms of the trunk, got L1_shank"),
    "eyes exchanged": (
        "toml",
        '["camera_left", "camera_right"]',
        '["camera_right", "camera_left"]',
        "expected the left eye first",
    ),
    "eyes outside": (
        "toml",
        '["hull", "face"]',
        '["battery"]',
        "shape: expected geoms that reach beyond the eye camera_left",
    ),
    "no free joint": ("xml", "<freejoint/>", "", "trunk: expected a body with a free joint, got platform"),
    "no range": (
        "xml",
        '"L1_lift" axis="1 0 0"',
        '"L1_lift" axis="1 0 0" limited="false"',
        "expected joints with limits, got L1_lift",
    ),
    "slanted axis": (
        "xml",
        '"L1_lift" axis="1 0 0"',
        '"L1_lift" axis="1 0 0.2"',
        "expected a horizontal axis of L1_lift, got one 11 deg from that",
    ),
    "no torque limit": (
        "xml",
        'joint="L1_yaw" kp="60" kv="0.6" forcerange="-1.8 1.8"',
        'joint="L1_yaw" kp="60" kv="0.6"',
        "expected a servo with a torque limit on joint L1_yaw",
    ),
    "motor": (
        "xml",
        '<position name="servo_R3_lift" joint="R3_lift" kp="60" kv="0.6" forcerange="-1.8 1.8" inheritrange="1"/>',
        '<motor joint="R3_lift"/>',
        "expected a position servo with gear 1 on joint R3_lift",
    ),
    "equality": (
        "xml",
        "<actuator>",
        '<equality><joint joint1="L1_yaw"/></equality><actuator>',
        "expected a robot without equality constraints, got 1",
    ),
    "asymmetric": (
        "xml",
        '<body name="R2_shank" pos="0 0.0594 0">',
        '<body name="R2_shank" pos="0 0.0634 0">',
        "legs.right_middle: expected a mirror image of the left leg, got a length or place that differs by 4.0 mm",
    ),
    "narrow knee": (
        "xml",
        '"L2_knee" axis="-1 0 0" range="20 190"',
        '"L2_knee" axis="-1 0 0" range="20 120"',
        "legs.left_middle: expected a tibia from",
    ),
    "too heavy": ("xml", 'mass="1.7"', 'mass="170"', "expected servos that hold the robot"),
    "broken": ("xml", "<worldbody>", "<worldbodies>", "mjcf: expected a MuJoCo model, got one that fails"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_with_what_to_do(fault, tmp_path):
    kind, before, after, message = FAULTS[fault]
    texts = {"toml": TOML, "xml": XML}
    assert before in texts[kind]
    path = write(tmp_path, **{**texts, kind: texts[kind].replace(before, after)})
    with pytest.raises(InputError, match=re.escape(message)) as raised:
        custom_robot.read(path)
    assert str(path) in str(raised.value) and "; " in str(raised.value) and "\n" not in str(raised.value)


def test_a_free_ankle_is_refused(tmp_path):
    with pytest.raises(InputError, match=r'joint R1_ankle, which is no coxa.*add `"R1_ankle" = 0\.0`'):
        custom_robot.read(write(tmp_path, xml=with_ankles(XML)))
