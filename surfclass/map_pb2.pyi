from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class MapUpdate(_message.Message):
    __slots__ = ("epoch", "sequence", "t_ns", "classes", "voxels", "part", "parts", "index", "colour", "texture", "weight", "colour_count", "texture_count")
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    CLASSES_FIELD_NUMBER: _ClassVar[int]
    VOXELS_FIELD_NUMBER: _ClassVar[int]
    PART_FIELD_NUMBER: _ClassVar[int]
    PARTS_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COLOUR_FIELD_NUMBER: _ClassVar[int]
    TEXTURE_FIELD_NUMBER: _ClassVar[int]
    WEIGHT_FIELD_NUMBER: _ClassVar[int]
    COLOUR_COUNT_FIELD_NUMBER: _ClassVar[int]
    TEXTURE_COUNT_FIELD_NUMBER: _ClassVar[int]
    epoch: str
    sequence: int
    t_ns: int
    classes: int
    voxels: int
    part: int
    parts: int
    index: bytes
    colour: bytes
    texture: bytes
    weight: bytes
    colour_count: bytes
    texture_count: bytes
    def __init__(self, epoch: _Optional[str] = ..., sequence: _Optional[int] = ..., t_ns: _Optional[int] = ..., classes: _Optional[int] = ..., voxels: _Optional[int] = ..., part: _Optional[int] = ..., parts: _Optional[int] = ..., index: _Optional[bytes] = ..., colour: _Optional[bytes] = ..., texture: _Optional[bytes] = ..., weight: _Optional[bytes] = ..., colour_count: _Optional[bytes] = ..., texture_count: _Optional[bytes] = ...) -> None: ...
