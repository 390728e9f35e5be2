"""Reads `captures.csv`, one row a capture; every fault is named by file, line and column."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfclass.errors import InputError
from surfclass.frames import ROLES
from surfclass.types import Float64, Transform

JOINTS = tuple(f"q{axis}" for axis in range(1, 7))
POSE = tuple(f"p{row}{column}" for row in range(3) for column in range(4))
COLUMNS = ("name", "role", "t_ns", "exposure_s", *JOINTS, *POSE)

# A name becomes a file's name in every set and recording made of it.
_NAME = re.compile(r"[^\s./\\\x00-\x1f][^/\\\x00-\x1f]*")
_MAX_T_NS = 2**62
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One row, checked.

    Attributes:
        where: File and line, for messages about what the row names.
        name: Unique in the file.
        role: One of `surfclass.frames.ROLES`.
        t_ns: Mid-exposure.
        exposure_s: None where it is not known.
        q: (6,) rad, or None.
        base_T_depth: The depth camera's pose, or None.
    """

    where: str
    name: str
    role: str
    t_ns: int
    exposure_s: float | None
    q: Float64 | None
    base_T_depth: Transform | None


def read_captures_csv(path: Path) -> tuple[Row, ...]:
    """Returns the rows in order.

    Raises:
        InputError: Naming the file, the line and the column, and what is allowed there.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: missing; a data folder lists its captures there") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text: {error}") from None
    reader = csv.reader(text.splitlines(), strict=True)
    rows: dict[str, Row] = {}
    try:
        _check_header(path, next(reader, []))
        for fields in reader:
            if not any(field.strip() for field in fields):
                continue
            where = f"{path}, line {reader.line_num}"
            if len(fields) != len(COLUMNS):
                raise InputError(f"{where}: {len(fields)} fields, allowed are {len(COLUMNS)}")
            row = _row(where, dict(zip(COLUMNS, (field.strip() for field in fields), strict=True)))
            if row.name in rows:
                raise InputError(f"{where}, column name: {row.name!r} is already at {rows[row.name].where}")
            rows[row.name] = row
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: not CSV: {error}") from None
    if not rows:
        raise InputError(f"{path}: no captures")
    return tuple(rows.values())


def _check_header(path: Path, header: list[str]) -> None:
    found = [column.strip() for column in header]
    if found == list(COLUMNS):
        return
    missing = [column for column in COLUMNS if column not in found]
    unknown = [column for column in found if column not in COLUMNS]
    if missing or unknown:
        faults = [f"{what} {', '.join(map(repr, names))}" for what, names in
                  (("missing", missing), ("unknown", unknown)) if names]  # fmt: skip
        fault = "; ".join(faults)
    else:
        fault = "a column appears twice, or the order is another"
    raise InputError(f"{path}, line 1: columns: {fault}; allowed is {','.join(COLUMNS)}")


def _row(where: str, fields: dict[str, str]) -> Row:
    name, role = fields["name"], fields["role"]
    if _NAME.fullmatch(name) is None:
        raise InputError(
            f"{where}, column name: {name!r}, allowed is a file name that does not start with a dot"
        )
    if role not in ROLES:
        raise InputError(f"{where}, column role: {role!r}, allowed: {', '.join(ROLES)}")
    if re.fullmatch(r"\d{1,19}", fields["t_ns"]) is None or int(fields["t_ns"]) > _MAX_T_NS:
        raise InputError(
            f"{where}, column t_ns: {fields['t_ns']!r}, allowed is a whole number of ns, 0 to {_MAX_T_NS}"
        )
    exposure = _numbers(where, fields, ("exposure_s",))
    if exposure is not None and exposure[0] <= 0:
        raise InputError(f"{where}, column exposure_s: {exposure[0]:g}, allowed is above 0, or empty")
    q, upper = _numbers(where, fields, JOINTS), _numbers(where, fields, POSE)
    if q is None and upper is None:
        raise InputError(f"{where}: capture {name} has neither q1…q6 nor p00…p23; one of them is needed")
    return Row(
        where=where,
        name=name,
        role=role,
        t_ns=int(fields["t_ns"]),
        exposure_s=None if exposure is None else exposure[0],
        q=None if q is None else np.array(q),
        base_T_depth=None if upper is None else _pose(where, upper),
    )


def _numbers(where: str, fields: dict[str, str], columns: tuple[str, ...]) -> list[float] | None:
    """The columns' numbers, or None where all are empty; some empty is a fault."""
    empty = [column for column in columns if not fields[column]]
    if len(empty) == len(columns):
        return None
    if empty:
        raise InputError(f"{where}, column {empty[0]}: empty, but {columns[0]}…{columns[-1]} go together")
    numbers = []
    for column in columns:
        try:
            number = float(fields[column])
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f"{where}, column {column}: {fields[column]!r}, allowed is a finite number")
        numbers.append(number)
    return numbers


def _pose(where: str, upper: list[float]) -> Transform:
    """The pose with the rotation that is nearest to the 3 × 3 in the file (by its SVD).

    Trackers write single precision that has drifted: real sets are off by 3e-4.
    """
    rows = np.reshape(upper, (3, 4))
    left, stretch, right = np.linalg.svd(rows[:, :3])
    determinant = np.linalg.det(left @ right)
    if np.abs(stretch - 1).max() > _ROTATION_TOLERANCE or determinant < 0:
        raise InputError(
            f"{where}, columns p00…p22: no rotation (singular values {stretch[0]:.5g} to {stretch[2]:.5g}, "
            f"determinant {determinant:+.0f}; allowed 1 ± {_ROTATION_TOLERANCE:g}, +1)"
        )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = left @ right, rows[:, 3]
    return Transform("base", "depth", matrix)
