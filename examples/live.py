"""Live SLAM from Python: python examples/live.py path/to/recording

The recording stands in for a camera: ``track`` takes colour and depth images from any source.
"""

import sys
from pathlib import Path

from bmask_slam import LiveOptions, LiveSlam, open_sequence

sequence = open_sequence(Path(sys.argv[1]))
with LiveSlam(sequence.camera, options=LiveOptions(out=Path("runs/live"), overwrite=True)) as slam:
    for frame in sequence.frames():
        result = slam.track(frame.timestamp_s, frame.rgb, frame.depth_m)
        if result.T_world_camera is not None:
            x, y, z = result.T_world_camera[:3, 3]
            print(f"{frame.timestamp_s:.3f}  {result.status.value}  {x:.3f} {y:.3f} {z:.3f} m")
    print(slam.health().line())
