"""Which readings of joints no arm can give."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.joint_limits import VM_6083_DEG, JointLimits
from drivers.sim.arm import LIMITS
from surfclass.errors import InputError
from surfclass.frames import JointState

MS = 1_000_000


def reading(degrees, t_ms=0.0, sd_ms=0.0):
    return JointState(round(t_ms * MS), round(sd_ms * MS), np.radians(degrees))


@pytest.fixture
def limits():
    return JointLimits(VM_6083_DEG, 3.0, 720.0)


def test_the_limits_are_those_of_the_arm():
    assert np.radians(VM_6083_DEG) == pytest.approx(LIMITS)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", [0, 1])
def test_an_angle_within_the_margin_is_possible_and_beyond_it_is_not(limits, joint, side):
    outward = 1 if side else -1
    degrees = np.array([0.0, 0, 45, 0, 0, 0])
    degrees[joint] = VM_6083_DEG[joint][side] + outward * 2.9
    assert limits.complaint(reading(degrees)) == ""
    limits.forget()
    degrees[joint] = VM_6083_DEG[joint][side] + outward * 3.1
    assert f"joint {joint + 1} at" in limits.complaint(reading(degrees))


def test_a_joint_turns_no_faster_than_its_speed_and_the_times_uncertainty_allow(limits):
    rest = [0, 0, 90, 0, 0, 0]
    assert limits.complaint(reading(rest, 0)) == ""
    assert limits.complaint(reading([0, 0, 90, 5, 0, 0], 8)) == ""
    assert "joint 5 turned by 20°" in limits.complaint(reading([0, 0, 90, 5, 20, 0], 16))
    assert limits.complaint(reading([0, 0, 90, 5, 20, 0], 16, sd_ms=20)) == ""


def test_a_reading_that_is_not_believed_is_not_compared_with(limits):
    assert limits.complaint(reading([0, 0, 90, 0, 0, 0], 0)) == ""
    assert limits.complaint(reading([90, 0, 90, 0, 0, 0], 8)) != ""
    assert limits.complaint(reading([0, 0, 90, 0, 0, 0], 16)) == ""


def test_after_a_pause_the_arm_may_be_anywhere(limits):
    assert limits.complaint(reading([-170, 0, 90, 0, 0, 0], 0)) == ""
    assert limits.complaint(reading([170, 0, 90, 0, 0, 0], 1000)) == ""
    limits.forget()
    assert limits.complaint(reading([-170, 0, 90, 0, 0, 0], 1000)) == ""


@pytest.mark.parametrize(
    "how",
    [
        (VM_6083_DEG[:5], 3.0, 720.0),
        (((1.0, 1.0),) * 6, 3.0, 720.0),
        (VM_6083_DEG, -1.0, 720.0),
        (VM_6083_DEG, 3.0, 0.0),
        (VM_6083_DEG, float("nan"), 720.0),
    ],
    ids=["five joints", "no range", "margin below 0", "no speed", "no number"],
)
def test_limits_that_are_none_are_refused(how):
    with pytest.raises(InputError, match="allowed"):
        JointLimits(*how)
