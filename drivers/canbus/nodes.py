"""Which CANopen nodes the joints are, and how they are read."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, Strict, field_validator, model_validator

from drivers.canbus.joints import JOINTS
from drivers.canbus.options import ReaderOptions
from surfclass.schema import Positive, Table

_AXIS = 0x800  # CiA 402: from an axis of a drive to the next
_OBJECTS = (0x6004, *range(0x6064, 0xA000, _AXIS))


class JointNode(Table):
    """Where a joint's angle is: sign · 2π · (position − zero_counts) / counts_per_turn.

    Attributes:
        node_id: CANopen's node.
        object: 0x6004, the position of a CiA 406 encoder, or 0x6064, the actual position of a CiA 402
            drive (0x6864, 0x7064 … of its further axes).
        counts_per_turn: Counts in a turn of the JOINT, gear included.
        zero_counts: The position where the joint's angle is 0.
        range_counts: Where the position starts again from 0: the encoder's total measuring range.
        sign: -1 where it turns the other way.
    """

    node_id: Annotated[int, Strict(), Field(ge=1, le=127)]
    object: Annotated[int, Strict()]
    counts_per_turn: Positive
    zero_counts: Annotated[int, Strict()] = 0
    range_counts: Annotated[int, Strict(), Field(ge=2, le=1 << 32)] = 1 << 32
    sign: Literal[1, -1] = 1

    @field_validator("object")
    @classmethod
    def _known(cls, value: int) -> int:
        if value not in _OBJECTS:
            raise ValueError(f"0x{value:X} is no position: allowed are 0x6004 and 0x6064 + n · 0x800")
        return value

    def angle(self, data: bytes) -> float:
        """Returns the angle, rad, of an object's four bytes."""
        counts = int.from_bytes(data, "little") - self.zero_counts
        half = self.range_counts // 2
        counts = (counts + half) % self.range_counts - half
        return self.sign * math.tau * counts / self.counts_per_turn


class JointNodes(Table):
    """The nodes of the six joints."""

    j1: JointNode
    j2: JointNode
    j3: JointNode
    j4: JointNode
    j5: JointNode
    j6: JointNode


class CanopenOptions(ReaderOptions):
    """The joints in objects of CANopen nodes.

    Attributes:
        nodes: An object for each of j1 to j6.
        read: "pdo": nodes send them after each SYNC (transmission type 1; the mapping is read from
            the node, never changed); "sdo": they are asked for one by one, every `period_ms`.
        sync_id: COB-ID of the SYNC.
        send_sync: Whether the SYNC is sent from here, every `period_ms`; False: another node does it.
        start_nodes: Whether the nodes are set operational, again when they boot.
        sdo_timeout_s: How long a node may take to answer.
    """

    nodes: JointNodes
    read: Literal["pdo", "sdo"]
    sync_id: Annotated[int, Strict(), Field(ge=1, le=0x7FF)] = 0x80
    send_sync: Annotated[bool, Strict()] = False
    start_nodes: Annotated[bool, Strict()] = False
    sdo_timeout_s: Annotated[Positive, Field(le=1)] = 0.2

    @model_validator(mode="after")
    def _fits(self) -> CanopenOptions:
        if self.read == "sdo" and self.send_sync:
            raise ValueError('send_sync: for read = "pdo" alone')
        if self.read == "pdo" and self.window_ms > self.period_ms:
            raise ValueError(
                f"window_ms: {self.window_ms:g} is longer than period_ms, {self.period_ms:g}: "
                "a set could hold answers to two SYNCs"
            )
        if self.listen_only:
            raise ValueError("listen_only: the nodes have to be asked; with a DBC file nothing is sent")
        taken: dict[tuple[int, int], str] = {}
        for joint in JOINTS:
            node: JointNode = getattr(self.nodes, joint)
            if (other := taken.setdefault((node.node_id, node.object), joint)) != joint:
                raise ValueError(
                    f"nodes.{joint}: object 0x{node.object:X} of node {node.node_id} is {other} already"
                )
        return self
