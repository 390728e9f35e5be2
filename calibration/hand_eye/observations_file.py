"""The JSON file of hand-eye observations: any target, any detector."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator, model_validator

from calibration.hand_eye.observations import (
    PROBE_SD_M,
    Intrinsics,
    Mounting,
    Observations,
    Pixels,
    Positions,
    Probed,
    View,
    virtual_points,
)
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import Matrix4
from surfclass.schema import Number, Positive, Table, Vector3, validate
from surfclass.types import Transform

SCHEMA = 1


class _Point(Table):
    target_m: Vector3
    pixel: tuple[Number, Number] | None = None
    camera_m: Vector3 | None = None
    sd_px: Positive | None = None
    sd_m: Positive | None = None

    @model_validator(mode="after")
    def _is_seen(self) -> _Point:
        if self.pixel is None and self.camera_m is None:
            raise ValueError("a point needs a pixel, camera_m, or both")
        for sd, what, seen in (("sd_px", "pixel", self.pixel), ("sd_m", "camera_m", self.camera_m)):
            if getattr(self, sd) is not None and seen is None:
                raise ValueError(f"{sd} without {what}")
        return self

    @field_validator("camera_m")
    @classmethod
    def _in_front(cls, value: Vector3 | None) -> Vector3 | None:
        if value is not None and value[2] <= 0:
            raise ValueError("z must be positive: the point is behind the camera")
        return value


class _Pose(Table):
    name: str | None = None
    base_T_flange: Matrix4
    q: tuple[Number, Number, Number, Number, Number, Number] | None = None
    points: tuple[_Point, ...] = ()
    camera_T_target: Matrix4 | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> _Pose:
        if ("points" in self.model_fields_set) == (self.camera_T_target is not None):
            raise ValueError("needed is either points or camera_T_target")
        places = [point.target_m for point in self.points]
        if len(set(places)) != len(places):
            raise ValueError("two points have the same target_m")
        return self


class _Intrinsics(Table):
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)


class _Probed(Table):
    target_m: Vector3
    position_m: Vector3
    sd_m: Positive = PROBE_SD_M


_ProbedPoints = Annotated[tuple[_Probed, ...], Field(min_length=1)]
_Side = Annotated[int, Field(gt=0, strict=True)]


class _File(Table):
    schema_version: Annotated[int, Field(alias="schema", strict=True)]
    mounting: Mounting
    image_size: tuple[_Side, _Side] | None = None
    intrinsics: _Intrinsics | None = None
    target_prior_base_m: _ProbedPoints | None = None
    target_prior_flange_m: _ProbedPoints | None = None
    poses: Annotated[tuple[_Pose, ...], Field(min_length=1)]

    @field_validator("schema_version")
    @classmethod
    def _schema_is_known(cls, version: int) -> int:
        if version != SCHEMA:
            raise ValueError(f"unknown schema, allowed is {SCHEMA}")
        return version

    @model_validator(mode="after")
    def _agrees(self) -> _File:
        names = [pose.name for pose in self.poses if pose.name is not None]
        if len(set(names)) != len(names):
            raise ValueError("two poses have the same name")
        other = "flange" if self.mounting == "eye_in_hand" else "base"
        if getattr(self, f"target_prior_{other}_m") is not None:
            raise ValueError(
                f"target_prior_{other}_m: with {self.mounting} the target is not fixed in {other}"
            )
        pairs = {pose.camera_T_target is None for pose in self.poses}
        if len(pairs) > 1:
            raise ValueError("some poses have points and others camera_T_target; all need the same")
        return self


def read_observations(path: Path) -> Observations:
    """Returns what an observations file says (`schema` 1).

    Raises:
        InputError: If the file cannot be read.
        ConfigurationError: As `parse_observations`.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    return parse_observations(text, str(path))


def parse_observations(text: str | bytes, source: str) -> Observations:
    """Returns what the JSON `text` says.

    Args:
        text: The file.
        source: What to call it in a message.

    Raises:
        ConfigurationError: Naming every fault by its path, such as `poses.3.points.0.pixel`.
    """
    try:
        data = json.loads(text, object_pairs_hook=_no_double_keys)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{source}: not a JSON file: {error}") from None
    if not isinstance(data, dict):
        raise ConfigurationError(f"{source}: needed is an object with schema, mounting and poses")
    told = validate(_File, data, source)
    prior = told.target_prior_base_m or told.target_prior_flange_m
    return Observations(
        told.mounting,
        tuple(_view(number, pose) for number, pose in enumerate(told.poses)),
        None if told.intrinsics is None else Intrinsics(**told.intrinsics.model_dump()),
        told.image_size,
        None if prior is None else _probed(prior),
    )


def _no_double_keys(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise ValueError(f"the key {key!r} appears twice in one object")
    return dict(pairs)


def _probed(points: Sequence[_Probed]) -> Probed:
    columns = zip(*((point.target_m, point.position_m, point.sd_m) for point in points), strict=True)
    target, fixed, sd = (np.array(column, np.float64) for column in columns)
    return Probed(target, fixed, sd)


def _view(number: int, pose: _Pose) -> View:
    name = f"{number}" if pose.name is None else pose.name
    base_T_flange = Transform("base", "flange", np.array(pose.base_T_flange))
    q = None if pose.q is None else np.array(pose.q, np.float64)
    if pose.camera_T_target is not None:
        seen = virtual_points(Transform("camera", "target", np.array(pose.camera_T_target)))
        return View(name, base_T_flange, positions=seen, q=q, sizeless=True)
    shown = [point for point in pose.points if point.pixel is not None]
    measured = [point for point in pose.points if point.camera_m is not None]
    pixels = Pixels(
        np.array([point.target_m for point in shown], np.float64).reshape(-1, 3),
        np.array([point.pixel for point in shown], np.float64).reshape(-1, 2),
        np.array([point.sd_px or 1.0 for point in shown], np.float64),
    )
    positions = Positions(
        np.array([point.target_m for point in measured], np.float64).reshape(-1, 3),
        np.array([point.camera_m for point in measured], np.float64).reshape(-1, 3),
        np.array([point.sd_m or 1.0 for point in measured], np.float64),
    )
    return View(name, base_T_flange, pixels, positions, q)
