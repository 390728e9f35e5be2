"""Recordings: `RecordingWriter` writes one, `Recording` reads it, `recover` saves what a crash left."""

from drivers.recording_reader import Recording
from drivers.recording_recovery import recover
from drivers.recording_writer import RecordingWriter, unix_offset_ns

__all__ = ["Recording", "RecordingWriter", "recover", "unix_offset_ns"]
