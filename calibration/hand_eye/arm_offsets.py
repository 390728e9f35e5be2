"""Joint offsets and the last D-H length beside the hand-eye transform: which can be told, and why not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.hand_eye.adjustment import Fit
from calibration.hand_eye.problem import Problem
from calibration.hand_eye.variance import adjust_weighted
from surfclass.errors import InputError

_MOST_SD_RAD = np.radians(0.3)
_INNER = (1, 2, 3, 4)  # joints 2 to 5


@dataclass(frozen=True, slots=True, eq=False)
class ArmOffsets:
    """What of the arm was asked for.

    Attributes:
        fit: With the offsets that can be told.
        not_observable: By key of `rig.toml`: why the views cannot tell it.
    """

    fit: Fit
    not_observable: dict[str, str]


def free_offsets(problem: Problem, fit: Fit, joints: bool, flange_offset: bool) -> ArmOffsets:
    """Returns the adjustment with those offsets that the poses determine.

    Joint 1 turns the arm as a whole, which is the same as the target turned the other way: it stays 0, and
    so does joint 6, which is the same as the camera turned on the flange. The last D-H length moves the
    flange along joint 6's axis, which is the same as the camera moved on the flange. (Probed points do not
    help: they were touched with the same arm.)

    Args:
        problem: The observations.
        fit: Without offsets.
        joints: Whether joint offsets are asked for.
        flange_offset: Whether the last D-H length is.

    Raises:
        InputError: If the views have no joint angles, or those of an arm whose model is not here.
    """
    if problem.q is None:
        raise InputError(
            "joint offsets and the last D-H length need every pose's joint angles q, and they must give its "
            "base_T_flange by the arm's model to 0.1 mm"
        )
    camera, target = ("camera", "target") if problem.in_hand else ("target", "camera")
    told: dict[str, str] = {}
    if flange_offset:
        told["arm.flange_offset_m"] = (
            f"moving the flange along joint 6's axis is the same as moving the {camera} on it by as much the "
            "other way, so no view tells the two apart; the hand-eye transform holds their sum"
        )
    if not joints:
        return ArmOffsets(fit, told)
    told["arm.joint_offsets_rad[0]"] = (
        f"turning joint 1 is the same as turning the {target} about base z the other way; it stays as it was"
    )
    told["arm.joint_offsets_rad[5]"] = (
        f"turning joint 6 is the same as turning the {camera} on the flange the other way; it stays as it was"
    )
    chosen = list(_INNER)
    while chosen:
        free = replace(fit.free, joints=tuple(chosen))
        found = adjust_weighted(problem, fit.state, free, fit.keep, fit.noise)
        sd = np.sqrt(np.maximum(np.diag(found.covariance)[found.places.joints], 0))
        undetermined = np.diag(found.reduced)[found.places.joints] * sd**2 < 0.5
        worst = int(np.argmax(np.where(undetermined, np.inf, sd)))
        if not undetermined[worst] and sd[worst] < _MOST_SD_RAD:
            return ArmOffsets(found, told)
        told[f"arm.joint_offsets_rad[{chosen[worst]}]"] = (
            f"the poses determine joint {chosen[worst] + 1}'s offset to no better than "
            f"{np.degrees(sd[worst]):.2g}°: move joints {chosen[worst]} and {chosen[worst] + 2} through more "
            "of their range"
        )
        del chosen[worst]
    return ArmOffsets(fit, told)
