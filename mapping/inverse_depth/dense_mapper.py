"""Algorithm 1 on a stream of keyframes; each is fused once its later neighbours have come."""

from __future__ import annotations

import bisect
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bmask_slam.graph.arrays import Array, Bytes, Floats, Image, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.depth_map import (
    InverseDepthMap,
    MeasurementConfig,
    from_sensor,
)
from bmask_slam.mapping.inverse_depth.fusion import MAX_NEIGHBOURS, fuse, with_calibrated_variance
from bmask_slam.mapping.inverse_depth.plane_sweep import fill_missing, sweep
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.inverse_depth.search_range import search_range
from bmask_slam.mapping.inverse_depth.stereo import match_stereo
from bmask_slam.mapping.inverse_depth.warping import View

DepthSource = Literal["sensor", "both", "stereo", "motion"]
MIN_BASELINE_M, SWEEP_VIEWS = 0.03, 2
WINDOW = 6
"""Neighbours are chosen among so many keyframes before and after."""


@dataclass(frozen=True, eq=False)
class DenseKeyframe:
    """A keyframe as input of dense mapping.

    Attributes:
        id: its number in the map.
        T_world_camera: (4, 4).
        rgb: (H, W, 3) uint8, red first, undistorted.
        depth_m: (H, W) float32 of the sensor, undistorted, NaN where missing.
        landmark_ids: (L,) landmarks that it observes.
        landmark_depths_m: (L,) their z in its camera.
        instances: (H, W) uint16, number of the instance at each pixel, 0 for none; or None.
        right: (H, W, 3) uint8, the right image of a rectified pair whose left one is ``rgb``, with
            the camera's bf: u_right = u_left - bf / z; or None.
        unmatched: (H, W) bool, pixels that get no depth from matching of images; or None.
    """

    id: int
    T_world_camera: Array
    rgb: Image
    depth_m: Floats
    landmark_ids: Ints
    landmark_depths_m: Array
    instances: NDArray[np.uint16] | None = None
    right: Image | None = None
    unmatched: Mask | None = None


@dataclass(frozen=True, eq=False)
class FusedKeyframe:
    """A keyframe after Step 5.

    Attributes:
        keyframe: the input.
        map: inverse depth with a calibrated variance.
        views: (H, W) uint8, number of keyframes in each estimate; 0 where Step 5 filled a hole.
    """

    keyframe: DenseKeyframe
    map: InverseDepthMap
    views: Bytes


@dataclass(frozen=True)
class DenseConfig:
    """Configuration of the fusion.

    Attributes:
        measurement: what of a depth image is used, and how certain it is.
        neighbours: largest number of keyframes that are fused with a keyframe.
        source: "sensor"; "stereo", the keyframes' right images; "motion", a plane sweep between
            keyframes; or "both": the sensor, and where it has no depth the right image, or without
            one the sweep.
        device: torch's name of the device that computes it.
    """

    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    neighbours: int = MAX_NEIGHBOURS
    source: DepthSource = "sensor"
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A keyframe after Step 3."""

    keyframe: DenseKeyframe
    map: InverseDepthMap
    image: Tensor


class DenseMapper:
    """Receives keyframes one by one and returns each one fused after six later ones.

    Memory is bounded: at most thirteen keyframes are held, ordered by id. A keyframe may come late,
    after one with a higher id; keyframes that were fused before it came were fused without it.
    """

    def __init__(self, camera: Camera, config: DenseConfig | None = None) -> None:
        self.camera = camera
        self.config = config or DenseConfig()
        self._prepared: list[_Prepared] = []
        self._to_fuse: set[int] = set()

    def add(self, keyframe: DenseKeyframe, wanted: bool = True) -> list[FusedKeyframe]:
        """Add a keyframe; returns the keyframe whose neighbours are complete now, fused.

        A keyframe that is not ``wanted`` is only a neighbour of others and is not returned.
        """
        bisect.insort(self._prepared, self._prepare(keyframe), key=lambda p: p.keyframe.id)
        if wanted:
            self._to_fuse.add(keyframe.id)
        return self._finished(len(self._prepared) - WINDOW)

    def _prepare(self, keyframe: DenseKeyframe) -> _Prepared:
        """Steps 1 to 3 of a keyframe, with the keyframes before it."""
        config, measured = self.config, None
        image = as_image(keyframe.rgb, config.device)
        if config.source in ("sensor", "both"):
            measured = from_sensor(keyframe.depth_m, self.camera, config.measurement, config.device)
        if config.source != "sensor":
            matched = self._matched(keyframe, image)
            if keyframe.unmatched is not None:
                matched = matched.where(~torch.from_numpy(keyframe.unmatched).to(image.device))
            measured = matched if measured is None else fill_missing(measured, matched)
        assert measured is not None
        return _Prepared(keyframe, regularise(measured), image)

    def _matched(self, keyframe: DenseKeyframe, image: Tensor) -> InverseDepthMap:
        """Steps 1 and 2 with the right image, or else with the last keyframes before it apart."""
        window = search_range(keyframe.landmark_depths_m)
        if window is not None and keyframe.right is not None:
            right = as_image(keyframe.right, self.config.device)
            return match_stereo(image, right, self.camera, window)
        T_own_world = inverse(keyframe.T_world_camera)
        before = [p for p in self._prepared if p.keyframe.id < keyframe.id]
        others = [(p.image, T_own_world @ p.keyframe.T_world_camera) for p in before[-WINDOW:]]
        apart = [o for o in others if np.linalg.norm(o[1][:3, 3]) > MIN_BASELINE_M]
        if window is None or not apart or self.config.source == "stereo":
            empty = torch.full(image.shape[-2:], torch.nan, device=image.device)
            return InverseDepthMap(empty, empty)
        return sweep(image, apart[-SWEEP_VIEWS:], self.camera, window)

    def update_poses(self, poses: Mapping[int, Array]) -> None:
        """Replace the poses of held keyframes by T_world_camera (4, 4), by id."""
        for k, prepared in enumerate(self._prepared):
            T = poses.get(prepared.keyframe.id)
            if T is not None and T is not prepared.keyframe.T_world_camera:
                self._prepared[k] = replace(
                    prepared, keyframe=replace(prepared.keyframe, T_world_camera=T)
                )

    def relabel(self, keyframe_id: int, instances: NDArray[np.uint16], hidden: Mask) -> None:
        """Replace the instances (H, W) of a keyframe and remove the depth of its hidden pixels.

        One that was fused already gives later ones no such depth from then on. Nothing happens if
        it is not held any more.
        """
        for k, prepared in enumerate(self._prepared):
            if prepared.keyframe.id == keyframe_id:
                depth_m = np.where(hidden, np.float32(np.nan), prepared.keyframe.depth_m)
                keyframe = replace(
                    prepared.keyframe, instances=instances, depth_m=depth_m, unmatched=hidden
                )
                self._prepared[k] = self._prepare(keyframe)

    def remove(self, keyframe_ids: Collection[int]) -> None:
        """Remove held keyframes."""
        self._prepared = [p for p in self._prepared if p.keyframe.id not in keyframe_ids]
        self._to_fuse -= set(keyframe_ids)

    def flush(self) -> list[FusedKeyframe]:
        """Fuse and return the keyframes that still wait; the next one starts a new stream."""
        results = self._finished(len(self._prepared))
        self._prepared = []
        return results

    def _finished(self, end: int) -> list[FusedKeyframe]:
        """Fuse the held keyframes before ``end`` and drop those that no later one needs."""
        ids = [p.keyframe.id for p in self._prepared[: max(end, 0)]]
        results = [self._fuse(k) for k, number in enumerate(ids) if number in self._to_fuse]
        self._to_fuse -= set(ids)
        del self._prepared[: max(end - WINDOW, 0)]
        return results

    def _fuse(self, k: int) -> FusedKeyframe:
        own = self._prepared[k]
        window = self._prepared[max(k - WINDOW, 0) : k + WINDOW + 1]
        others = {p.keyframe.id: p for p in window if p is not own}
        chosen = choose_neighbours(
            own.keyframe, [p.keyframe for p in others.values()], self.config.neighbours
        )
        return fuse_keyframe(own, [others[n.id] for n in chosen], self.camera)


def check_device(name: str) -> None:
    """Raise InputError if torch has no device of this name on this machine."""
    try:
        torch.zeros(1, device=name).cpu()
    except (RuntimeError, AssertionError) as error:  # the latter: a torch without CUDA
        known = "cpu, cuda" if torch.cuda.is_available() else "cpu; torch sees no GPU"
        reason = str(error).partition("\n")[0][:80]
        raise InputError(f"--device {name}: not here ({reason}); there are: {known}") from error


def as_image(rgb: Image, device: str = "cpu") -> Tensor:
    """Colours (3, H, W), 0 to 255, of an image (H, W, 3), blurred over 3x3 pixels."""
    blurred = np.ascontiguousarray(cv2.blur(rgb, (3, 3)).transpose(2, 0, 1))
    return torch.from_numpy(blurred).to(device, torch.float32)


def fuse_keyframe(own: _Prepared, others: list[_Prepared], camera: Camera) -> FusedKeyframe:
    """Steps 4 and 5 of a keyframe with its neighbours."""
    T_own_world = inverse(own.keyframe.T_world_camera)
    views = [
        View(other.map, T_own_world @ other.keyframe.T_world_camera, other.image)
        for other in others
    ]
    result = fuse(own.map, views, camera, own.image)
    final = with_calibrated_variance(regularise(result.map), result)
    return FusedKeyframe(own.keyframe, final, result.views.cpu().numpy())


def choose_neighbours(
    own: DenseKeyframe, others: list[DenseKeyframe], count: int
) -> list[DenseKeyframe]:
    """The keyframes that share most landmarks with ``own``; of equals the nearer in id."""
    shared = [len(np.intersect1d(own.landmark_ids, o.landmark_ids)) for o in others]
    order = sorted(range(len(others)), key=lambda k: (-shared[k], abs(others[k].id - own.id)))
    return [others[k] for k in order[:count]]
