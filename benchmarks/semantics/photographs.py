"""The COCO excerpt: photographs to train on, and those that no training saw.

Held out are the excerpt's 124 images of COCO's val2017: neither YOLOX-Nano, which learned from
train2017, nor this project's heads have seen them.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from benchmarks.paths import SHARED
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.instances.coco_files import CocoFile, read_coco

EXCERPT = SHARED / "coco_excerpt"
IMAGES = EXCERPT / "images"
VAL2017 = Path(__file__).with_name("val2017.txt")


def held_out() -> CocoFile:
    """The photographs of val2017."""
    content = read_coco(EXCERPT / "instances.json")
    chosen = _val2017()
    return replace(content, images=tuple(i for i in content.images if i.number in chosen))


def write_training(path: Path) -> None:
    """Write a COCO file of the other photographs."""
    content = json.loads((EXCERPT / "instances.json").read_text(encoding="utf-8"))
    left_out = _val2017()
    content["images"] = [i for i in content["images"] if i["id"] not in left_out]
    content["annotations"] = [a for a in content["annotations"] if a["image_id"] not in left_out]
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content), encoding="utf-8")


def _val2017() -> set[int]:
    return {int(word) for word in VAL2017.read_text(encoding="utf-8").split()}
