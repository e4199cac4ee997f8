"""Reading RGB-D sequences in TUM layout."""

from slam.sequences.sequence import Sequence, SequenceConfig, open_sequence

__all__ = ["Sequence", "SequenceConfig", "open_sequence"]
