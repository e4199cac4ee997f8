"""Where live frames come from."""

from bmask_slam.live.sources.counts import SourceCounts
from bmask_slam.live.sources.source import Newest, RecordedSource, Source

__all__ = ["Newest", "RecordedSource", "Source", "SourceCounts"]
