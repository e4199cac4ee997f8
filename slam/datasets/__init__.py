"""Published recordings: where they lie, brought here, checked, unpacked, in TUM's layout."""

from bmask_slam.datasets.catalogue import Recording, read_catalogue
from bmask_slam.datasets.obtain import obtain

__all__ = ["Recording", "obtain", "read_catalogue"]
