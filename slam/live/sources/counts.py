"""What a source met that was not a frame as it should be."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass
class SourceCounts:
    """Counted as frames come.

    Attributes:
        unpaired_rgb, unpaired_depth: images without a partner near enough in time.
        duplicates: images whose stamp was there already.
        late: images that came after one with a later stamp.
        clock_jumps: how often the clock was set back.
        gaps: steps between frames over three times the usual one.
        broken: images or list lines that could not be read.
    """

    unpaired_rgb: int = 0
    unpaired_depth: int = 0
    duplicates: int = 0
    late: int = 0
    clock_jumps: int = 0
    gaps: int = 0
    broken: int = 0

    def line(self) -> str:
        """Those that are not zero, for a person; empty if all are."""
        named = {name.replace("_", " "): count for name, count in asdict(self).items()}
        return ", ".join(f"{count} {name}" for name, count in named.items() if count)
