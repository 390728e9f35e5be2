"""Recordings: `RecordingWriter` writes one, `Recording` reads it, `recover` saves what a crash left."""

from drivers.recordings.reader import Recording
from drivers.recordings.recovery import recover
from drivers.recordings.writer import RecordingWriter, unix_offset_ns

__all__ = ["Recording", "RecordingWriter", "recover", "unix_offset_ns"]
