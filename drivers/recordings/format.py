"""What a recording holds: topics, schemas, and one capture as messages and back.

A recording is an MCAP file without a profile. The metadata record `surfclass.recording` and the
attachments (`rig.toml` and the others that there are) come first, so that even an unfinished file says
what it is. Each capture is one message a part, `/capture` last: it lists the parts and closes them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray
from pydantic import ValidationError

from drivers.recordings.images import check_pixels, decode_image, image_format
from surfclass.errors import InputError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState
from surfclass.rig import Row4
from surfclass.schema import Number, Table
from surfclass.types import Transform

SCHEMA = "1"
METADATA = "surfclass.recording"
RIG, CLASSES, PLATE, BOARD = "rig.toml", "classes.toml", "plate.toml", "board.toml"
CAPTURE, JOINTS, MAP = "/capture", "/joints", "/map"
IMAGES = ("depth", "ir", "colour", "dark", "label")  # in the order in which they are written

CAPTURE_SCHEMA, MAP_SCHEMA = "surfclass.Capture", "surfclass.v1.MapUpdate"
RAW, COMPRESSED, JOINT_STATES = "foxglove.RawImage", "foxglove.CompressedImage", "foxglove.JointStates"

# `rgb16`, which Foxglove does not list, is rgb8 with little-endian 16-bit channels; step = 6 · width.
_ENCODINGS = {(3, 1): "rgb8", (3, 2): "rgb16", (1, 1): "mono8", (1, 2): "mono16"}
_PIXELS = {"depth": (1, (16,)), "ir": (1, (8, 16)), "label": (1, (8,))}
_COLOUR = (3, (8, 16))
_FRAME = {"depth": "depth", "ir": "depth"}


@dataclass(frozen=True, slots=True)
class Entry:
    """One message: where it goes, what type it is, when it was (Unix, ns), and its bytes."""

    topic: str
    schema: str
    time_ns: int
    sequence: int
    data: bytes


class FrameRecord(Table):
    """A frame without its pixels."""

    t_ns: int
    sequence: int
    exposure_s: Number | None
    t_sd_ns: int = 0
    gain_db: Number | None = None


class JointsRecord(Table):
    """When the joint angles of `/joints` held."""

    t_ns: int
    t_sd_ns: int


class CaptureRecord(Table):
    """A capture without its images and joint angles; times are CLOCK_MONOTONIC, ns.

    `images` lists the topics (without the slash) that hold the rest of it, under the same sequence.
    """

    name: str
    role: str
    images: tuple[str, ...]
    depth: FrameRecord
    colour: FrameRecord | None
    dark: FrameRecord | None
    joints: JointsRecord | None
    base_T_depth: tuple[Row4, Row4, Row4, Row4] | None
    light_level: Number | None
    joint_motion_rad: Number | None
    skew_ns: int
    light_timing: Literal["software", "hardware"] | None = None


@cache
def schemas() -> Mapping[str, tuple[str, bytes]]:
    """Each schema's encoding and definition by name; the map's comes from who records it."""
    types = {RAW: RawImage, COMPRESSED: CompressedImage, JOINT_STATES: JointStates}
    protobuf = {
        name: ("protobuf", build_file_descriptor_set(kind).SerializeToString(deterministic=True))
        for name, kind in types.items()
    }
    text = json.dumps(CaptureRecord.model_json_schema(), sort_keys=True)
    return {**protobuf, CAPTURE_SCHEMA: ("jsonschema", text.encode())}


def capture_images(capture: Capture) -> dict[str, NDArray[Any]]:
    """The images that the capture has, by kind, in the order of `IMAGES`."""
    images = {
        "depth": capture.depth.depth_mm,
        "ir": capture.depth.ir,
        "colour": None if capture.colour is None else capture.colour.rgb,
        "dark": None if capture.dark is None else capture.dark.rgb,
        "label": capture.label,
    }
    return {kind: image for kind in IMAGES if (image := images[kind]) is not None}


def capture_entries(
    capture: Capture, sequence: int, unix_offset_ns: int, encoded: Mapping[str, bytes]
) -> list[Entry]:
    """Returns the capture's messages; an image in `encoded` is kept as those bytes, others raw.

    Raises:
        InputError: If `encoded` has what the capture has not, or other pixels, or a time is before
            1970 in Unix time.
    """
    images = capture_images(capture)
    for kind in encoded.keys() - images.keys():
        raise InputError(f"capture {capture.name}: encoded {kind!r}, but its images are {', '.join(images)}")
    frames = {"colour": capture.colour, "dark": capture.dark}
    entries = []
    for kind, image in images.items():
        frame = frames.get(kind) or (capture.t_ns if kind == "label" else capture.depth)
        time_ns = (frame if isinstance(frame, int) else frame.t_ns) + unix_offset_ns
        source = f"capture {capture.name}, {kind} image"
        if kind in encoded:
            schema, message = COMPRESSED, _compressed(image, encoded[kind], source)
        else:
            schema, message = RAW, _raw(image)
        message.frame_id = _FRAME.get(kind, "rgb")
        entries.append(Entry(f"/{kind}", schema, time_ns, sequence, _stamped(message, time_ns, source)))
    if capture.joints is not None:
        time_ns = capture.joints.t_ns + unix_offset_ns
        states = JointStates()
        for axis, angle in enumerate(capture.joints.q, start=1):
            states.joints.add(name=f"joint_{axis}", position=float(angle))
        data = _stamped(states, time_ns, f"capture {capture.name}, joints")
        entries.append(Entry(JOINTS, JOINT_STATES, time_ns, sequence, data))
    data = _record(capture, tuple(images)).model_dump_json().encode()
    entries.append(Entry(CAPTURE, CAPTURE_SCHEMA, capture.t_ns + unix_offset_ns, sequence, data))
    return entries


def parse_record(data: bytes, source: str) -> CaptureRecord:
    """Returns what a `/capture` message says.

    Raises:
        InputError: If it is not such a message.
    """
    try:
        return CaptureRecord.model_validate_json(data)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        path = ".".join(str(step) for step in fault["loc"])
        raise InputError(f"{source}: the message is not a capture's: {path}: {fault['msg']}") from None


def capture_from(record: CaptureRecord, parts: Mapping[str, Entry], source: str) -> Capture:
    """Returns the capture that `record` closes, of the messages in `parts` by topic.

    Raises:
        InputError: If a part is missing, damaged, or not what it has to be.
    """
    where = f"{source}, capture {record.name}"
    images = {kind: _image(parts, kind, where) for kind in record.images if kind in IMAGES}
    if "depth" not in images or (record.colour is None) == ("colour" in images):
        raise InputError(f"{where}: the images {', '.join(record.images)} are not those it describes")

    def colour(kind: str, frame: FrameRecord | None) -> ColourFrame | None:
        if frame is None or kind not in images:
            return None
        return ColourFrame(
            frame.t_ns, frame.sequence, frame.exposure_s, images[kind], frame.t_sd_ns, frame.gain_db
        )

    pose = record.base_T_depth
    try:
        return Capture(
            name=record.name,
            role=record.role,
            depth=DepthFrame(
                record.depth.t_ns,
                record.depth.sequence,
                record.depth.exposure_s,
                images["depth"],
                images.get("ir"),
                record.depth.t_sd_ns,
            ),
            colour=colour("colour", record.colour),
            dark=colour("dark", record.dark),
            joints=None if record.joints is None else _joints(record.joints, parts, where),
            base_T_depth=None if pose is None else Transform("base", "depth", np.array(pose)),
            label=images.get("label"),
            light_level=record.light_level,
            joint_motion_rad=record.joint_motion_rad,
            skew_ns=record.skew_ns,
            light_timing=record.light_timing,
        )
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _record(capture: Capture, images: tuple[str, ...]) -> CaptureRecord:
    def frame(of: ColourFrame | DepthFrame | None) -> FrameRecord | None:
        if of is None:
            return None
        exposure = None if of.exposure_s is None else float(of.exposure_s)
        gain_db = of.gain_db if isinstance(of, ColourFrame) else None
        return FrameRecord(
            t_ns=int(of.t_ns),
            sequence=int(of.sequence),
            exposure_s=exposure,
            t_sd_ns=int(of.t_sd_ns),
            gain_db=None if gain_db is None else float(gain_db),
        )

    depth = frame(capture.depth)
    joints, pose = capture.joints, capture.base_T_depth
    motion, level = capture.joint_motion_rad, capture.light_level
    assert depth is not None
    return CaptureRecord(
        name=capture.name,
        role=capture.role,
        images=images,
        depth=depth,
        colour=frame(capture.colour),
        dark=frame(capture.dark),
        joints=None if joints is None else JointsRecord(t_ns=int(joints.t_ns), t_sd_ns=int(joints.t_sd_ns)),
        base_T_depth=None if pose is None else pose.matrix.tolist(),
        light_level=None if level is None else float(level),
        joint_motion_rad=None if motion is None else float(motion),
        skew_ns=int(capture.skew_ns),
        light_timing=capture.light_timing,
    )


def _raw(image: NDArray[Any]) -> Any:
    channels, bytes_each = (1 if image.ndim == 2 else image.shape[2]), image.dtype.itemsize
    return RawImage(
        width=image.shape[1],
        height=image.shape[0],
        encoding=_ENCODINGS[channels, bytes_each],
        step=image.shape[1] * channels * bytes_each,
        data=image.astype(image.dtype.newbyteorder("<"), copy=False).tobytes(),
    )


def _compressed(image: NDArray[Any], data: bytes, source: str) -> Any:
    if not np.array_equal(decode_image(data, source), image):
        raise InputError(f"{source}: the encoded image has other pixels than the capture")
    return CompressedImage(data=data, format=image_format(data, source))


def _stamped(message: Any, time_ns: int, source: str) -> bytes:
    if not 0 <= time_ns < 2**63:
        raise InputError(f"{source}: at {time_ns} ns of Unix time; allowed are 1970 to 2262")
    message.timestamp.FromNanoseconds(time_ns)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def _part(parts: Mapping[str, Entry], topic: str, where: str) -> Entry:
    if topic not in parts:
        raise InputError(f"{where}: its message on {topic} is missing")
    return parts[topic]


def _image(parts: Mapping[str, Entry], kind: str, where: str) -> NDArray[Any]:
    entry = _part(parts, f"/{kind}", where)
    where = f"{where}, {entry.topic}"
    try:
        if entry.schema == COMPRESSED:
            image = decode_image(CompressedImage.FromString(entry.data).data, where)
        elif entry.schema == RAW:
            image = _raw_image(RawImage.FromString(entry.data), where)
        else:
            raise InputError(f"{where}: a {entry.schema}, allowed are {RAW} and {COMPRESSED}")
    except DecodeError:
        raise InputError(f"{where}: not a {entry.schema} message") from None
    check_pixels(image, *_PIXELS.get(kind, _COLOUR), where)
    return image


def _raw_image(message: Any, where: str) -> NDArray[Any]:
    shapes = {name: shape for shape, name in _ENCODINGS.items()} | {"16UC1": (1, 2), "8UC1": (1, 1)}
    if message.encoding not in shapes:
        raise InputError(f"{where}: encoding {message.encoding!r}, allowed: {', '.join(shapes)}")
    channels, bytes_each = shapes[message.encoding]
    step, height, width = message.step, message.height, message.width
    if step != width * channels * bytes_each or len(message.data) != step * height or not step * height:
        raise InputError(
            f"{where}: {width} × {height} {message.encoding} does not fit {len(message.data)} bytes"
        )
    pixels = np.frombuffer(message.data, f"<u{bytes_each}").reshape(height, width, channels)
    return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)[
        :, :, 0 if channels == 1 else slice(None)
    ]


def _joints(record: JointsRecord, parts: Mapping[str, Entry], where: str) -> JointState:
    entry = _part(parts, JOINTS, where)
    try:
        joints = JointStates.FromString(entry.data).joints
    except DecodeError:
        raise InputError(f"{where}, {JOINTS}: not a {JOINT_STATES} message") from None
    return JointState(record.t_ns, record.t_sd_ns, np.array([joint.position for joint in joints]))
