"""Recordings: readers, the writer of sequence files, and the packets a driver would publish."""

from velod.io.model import DepthTruth, EventColumns, Imu, RecordingError, SequenceData, Truth
from velod.io.packets import Chunking
from velod.io.recording import FORMATS, Recording, open_recording
from velod.io.sequence import read_depth, write_recording

__all__ = [
    "FORMATS",
    "Chunking",
    "DepthTruth",
    "EventColumns",
    "Imu",
    "Recording",
    "RecordingError",
    "SequenceData",
    "Truth",
    "open_recording",
    "read_depth",
    "write_recording",
]
