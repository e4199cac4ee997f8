"""Writes docs/parameters.md from the configuration's dataclasses:  python docs/parameters.py"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

from bmask_slam.graph.files.yaml_file import format_yaml
from bmask_slam.system_config import SystemConfig

PAGE = Path(__file__).parent / "parameters.md"
UNITS = {
    "m": "m",
    "px": "px",
    "s": "s",
    "ms": "ms",
    "rad": "rad",
    "deg": "degrees",
    "hz": "Hz",
    "frames": "frames",
    "keyframes": "keyframes",
    "share": "share (0 to 1)",
}
"""What the last word of a name says."""
MEANINGS = {
    "features.bucket_px": "side of the cells over which keypoints are spread",
    "features.min_depth_m": "nearer depth is not used",
    "features.max_depth_m": "farther depth is not used",
    "tracking.search_radius_px": "of the first search, around the predicted places",
    "max_view_angle_deg": "a landmark is looked for where it is seen from within this angle",
    "match.max_distance": "largest Hamming distance of two descriptors, of 512 bits",
    "pose.kernel_widths": "of the robust kernel, in chi-square gates, one after the other",
    "pose.kernel_iterations": "Gauss-Newton steps for each width",
    "pose.final_rounds": "rounds without the kernel, each with the inliers of the last",
    "pose.final_iterations": "Gauss-Newton steps a round",
    "pose.step_tolerance": "a smaller step in rad and m ends the iteration",
    "pose.max_noise_scale": "by which the residuals may enlarge the assumed noise",
    "pose.min_points": "with fewer inliers there is no pose",
    "tracking.subpixel.enabled": "align matches to image patches",
    "tracking.subpixel.iterations": "of the alignment of a patch",
    "tracking.image_motion.enabled": "follow landmarks by optical flow where few are matched",
    "tracking.image_motion.corners": "at most so many are followed",
    "tracking.image_motion.min_inliers": "with fewer the flow gives no pose",
    "tracking.image_motion.max_ago_s": "a frame longer ago is not followed from",
    "mapping.fuse_radius_px": "landmarks that project nearer are compared, and fused if alike",
    "mapping.triangulation.min_parallax_deg": "smallest angle between two rays",
    "mapping.triangulation.max_depth_m": "farther points are not made",
    "relocalisation.min_matches": "with fewer a candidate is dropped",
    "relocalisation.reprojection_px": "largest error of an inlier",
    "factor_selection.max_observations": "a keyframe gives the graph at most so many",
    "factor_selection.bucket_px": "side of the cells over which they are spread",
    "factor_selection.window_min_shared": "landmarks that a keyframe of the window shares",
    "loops.enabled": "recognise places and close loops",
    "loops.robust": "kernel of a loop's factor",
    "loops.max_iterations": "of the graph when a loop enters it",
    "loops.verification.side_tolerance": "relative difference of two distances that count as alike",
    "loops.verification.min_matches": "with fewer a candidate is dropped",
    "loops.verification.min_consensus": "matches that agree on one motion",
    "loops.verification.max_sigma_rad": "a less certain loop is refused",
    "loops.verification.max_sigma_m": "a less certain loop is refused",
    "loops.verification.first_distance": "largest Hamming distance of the first matching",
    "loops.verification.first_ratio": "of best to second-best distance in the first matching",
    "sigma_rotation_rad_per_sqrt_m": "random walk of the heading by path",
    "sigma_rotation_rad_per_sqrt_rad": "random walk of the heading by turning",
    "semantics.objects.enabled": "make objects",
}
"""Of parameters that the docstring of their class does not name: by the end of their path."""
HEAD = """\
# Parameters

Every parameter of the system, its default and what it does; written by `docs/parameters.py` from
the code. One value is changed by `--set`, several by a YAML file that holds only what differs:

```
bmask-slam run path/to/recording --set tracking.min_inliers=20
bmask-slam run path/to/recording --config my.yaml
```

`bmask-slam run - --print-config` prints all of them resolved; a run folder's `config.yaml` holds
those of that run. An unknown name or a value of the wrong type is refused, with the name that is
closest.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *_group(SystemConfig, "")])


def _group(cls: Any, path: str) -> Iterator[str]:
    """Heading, text and table of a group, then its groups."""
    text, meanings = described(cls)
    hints = get_type_hints(cls)
    fields = [f for f in dataclasses.fields(cls) if f.init]
    groups = {f.name: nested for f in fields if (nested := _nested(hints[f.name]))}
    yield f"## `{path}`\n" if path else "## The whole system\n"
    yield f"{text}\n"
    rows = [_row(f, path, hints[f.name], meanings) for f in fields if f.name not in groups]
    if rows:
        yield "| parameter | default | unit | what |\n|---|---|---|---|"
        yield "\n".join(rows) + "\n"
    for name, nested in groups.items():
        yield from _group(nested, f"{path}.{name}" if path else name)


def _row(field: Any, path: str, hint: Any, meanings: dict[str, str]) -> str:
    name = f"{path}.{field.name}" if path else field.name
    default = format_yaml(_plain(_default(field)), flow=True).strip()
    by_path = (MEANINGS[end] for end in MEANINGS if f".{name}".endswith(f".{end}"))
    what = meanings.get(field.name) or next(by_path, "")
    what = what.strip().rstrip(";.").replace("|", "or")
    return f"| `{name}` | `{default}` | {unit(field.name, hint)} | {what} |"


def unit(name: str, hint: Any) -> str:
    """The unit of a parameter, by its name and type."""
    if hint is bool:
        return "true, false"
    if name.endswith("_m_s"):
        return "m/s"
    per = re.search(r"_(\w+)_per_(\w+)$", name)
    if per and {per[1].rpartition("_")[2], per[2]} <= {*UNITS, "sqrt"}:
        return f"{UNITS[per[1].rpartition('_')[2]]} per {per[2]}"
    return UNITS.get(name.rpartition("_")[2] or name, "")


def described(cls: Any) -> tuple[str, dict[str, str]]:
    """A class's docstring without the list of its attributes; what it says of each field."""
    text, _, listed = (inspect.getdoc(cls) or "").partition("Attributes:\n")
    meanings: dict[str, str] = {}
    for sentence in re.split(r"(?<=[.;])\s+", " ".join(text.split())):
        for name in re.findall(r"``(\w+)``", sentence):
            meanings[name] = " ".join(filter(None, (meanings.get(name), sentence)))
    for entry in _entries(listed):
        names, _, what = entry.partition(":")
        meanings |= {name.strip(): what for name in names.split(",")}
    named = {name: _as_markdown(" ".join(what.split())) for name, what in meanings.items()}
    return _as_markdown(text.strip()), named


def _as_markdown(text: str) -> str:
    return re.sub(r"``([^`]+)``", r"`\1`", text)


def _entries(listed: str) -> list[str]:
    """The attributes of a docstring, each with its further lines."""
    found: list[str] = []
    for line in inspect.cleandoc(listed).splitlines():
        if line.startswith(" ") and found:
            found[-1] += f" {line.strip()}"
        elif line.strip():
            found.append(line)
    return found


def _nested(hint: Any) -> Any:
    """The dataclass in ``X`` or ``X | None``, or None."""
    return next((h for h in (hint, *get_args(hint)) if dataclasses.is_dataclass(h)), None)


def _default(field: Any) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _plain(value: Any) -> Any:
    """A default as YAML can hold it."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return getattr(value, "value", value) if not isinstance(value, Path) else str(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
