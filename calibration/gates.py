"""The limits that a result has to keep to pass; the configuration's `[calibration.gates]` sets them."""

from __future__ import annotations

from surfclass.schema import Positive, Table


class CamerasGates(Table):
    """Of `calibrate cameras`."""

    rms_px: Positive = 0.5


class HandEyeGates(Table):
    """Of `calibrate hand-eye`."""

    translation_sd_m: Positive = 0.001


class LightGates(Table):
    """Of `calibrate light`."""

    position_sd_m: Positive = 0.010


class ResponseGates(Table):
    """Of `calibrate response`."""

    rms: Positive = 0.01


class LimitsGates(Table):
    """Of `calibrate limits`."""

    captures: Positive = 4


class VerifyGates(Table):
    """Of `verify`."""

    point_m: Positive = 0.003


class Gates(Table):
    """Every step's limits."""

    cameras: CamerasGates = CamerasGates()
    hand_eye: HandEyeGates = HandEyeGates()
    light: LightGates = LightGates()
    response: ResponseGates = ResponseGates()
    limits: LimitsGates = LimitsGates()
    verify: VerifyGates = VerifyGates()
