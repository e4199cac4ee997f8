"""Reading RGB-D sequences in TUM layout."""

from bmask_slam.sequences.cameras import format_camera, read_camera, write_camera
from bmask_slam.sequences.info import SequenceInfo, format_info, info_as_json, sequence_info
from bmask_slam.sequences.sequence import Sequence, SequenceConfig, open_sequence

__all__ = [
    "Sequence",
    "SequenceConfig",
    "SequenceInfo",
    "format_camera",
    "format_info",
    "info_as_json",
    "open_sequence",
    "read_camera",
    "sequence_info",
    "write_camera",
]
