"""Where live frames come from."""

from slam.live.sources.counts import SourceCounts
from slam.live.sources.source import Newest, RecordedSource, Source

__all__ = ["Newest", "RecordedSource", "Source", "SourceCounts"]
