"""A truncated signed distance volume: blocks of 8^3 voxels where frames saw surfaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.surface.blocks import (
    BRICK,
    BRICK_VOXELS,
    BRICKS,
    EDGE,
    block_indices,
    block_keys,
    lattice,
    open_tables,
    voxel_places,
)
from bmask_slam.mapping.surface.depth_frame import DepthFrame, gains
from bmask_slam.mapping.surface.kernel import NEAREST_M, add_frame
from bmask_slam.mapping.surface.pixel_planes import BEHIND, NX, NZ, OFFSET, WEIGHT, Z

FRONT_VOXELS = 8
"""Distances in front of a surface are cut off at so many voxels."""
COLOUR_VOXELS = 2.0
"""Voxels this near to a surface take its colour, and count the frame as a witness of it."""
FREE_SHARE = 0.02
"""A ray passes a voxel freely if the surface is farther by the cut-off and this share of depth."""
MAX_RAY_STEP_PX = 4
SAMPLES = 4800
"""About so many pixels tell about a frame's exposure."""
RELEASE_FRAMES = 32
"""So often the memory of the tables is given back."""


class SurfaceVolume:
    """Weighted means of the distances to the surface that frames measured (Curless and Levoy 1996).

    Voxels are those of bricks, eight to a block; the voxel at index i has its centre at
    i * voxel_m. What lies in front of a measured surface is also counted as free, wherever there is
    a block, so that what moved away can be found.

    The tables lie in files without names, see ``FileTable``: in memory is what the last frames saw.

    Attributes:
        voxel_m: edge of a voxel.
        distance: (8 B, 64) float32, metres, positive in front of the surface.
        weight: (8 B, 64) float32, sum of 1 / sigma^2 in 1/cm^2; 0 where unknown.
        witnesses, free: (8 B, 64) float16, frames that saw a surface at the voxel, and through it;
            both are halved where one is more than 2048.
        colour: (8 B, 64, 4) float16, 0 to 255, and the sum of its weights.
    """

    distance: Tensor
    weight: Tensor
    witnesses: Tensor
    free: Tensor
    colour: Tensor

    def __init__(
        self,
        voxel_m: float,
        camera: Camera,
        blocks: int = 1024,
        folder: Path | None = None,
        kept: Ints | None = None,
    ) -> None:
        """An empty volume, or that in the files of a folder.

        The tables hold so many ``blocks`` before they grow. Their files in ``folder`` (None: the
        system's for such) vanish with the volume; with ``kept`` they stay, and hold the blocks with
        these keys (B,). Raises InputError: the files cannot be made.
        """
        self.voxel_m, self._camera = voxel_m, camera
        self._number: dict[int, int] = {}
        self._origin = torch.zeros((0, 3))
        self._tables = open_tables(folder, kept is not None)
        self._frames = 0
        self._voxels = lattice(BRICK, 1) * voxel_m
        self._bricks = lattice(EDGE, BRICK) * voxel_m
        self._reserve(max(blocks, 0 if kept is None else len(kept)))
        self._add_blocks([] if kept is None else kept.tolist())

    def release(self) -> None:
        """Give back the memory of the tables; what is used again is read again."""
        for table in self._tables.values():
            table.release()

    def close(self) -> None:
        """Let kept files end where the blocks do; the volume is not used any more."""
        for table in self._tables.values():
            table.cut(len(self) * BRICKS)

    def __len__(self) -> int:
        return len(self._number)

    @property
    def keys(self) -> Ints:
        """Keys (B,) of the blocks in the order of the tables, see ``block_keys``."""
        return np.fromiter(self._number, np.int64, len(self))

    def integrate(self, frame: DepthFrame, only: Tensor | None = None) -> Ints:
        """Add what a frame measured, if given to those blocks (B,) only that exist and are marked.

        Returns the numbers of the blocks that changed.

        Raises:
            InputError: the disk is full.
        """
        gain = self._gain(frame)
        if only is None:
            self._make_blocks(frame)
        T_camera_world = torch.from_numpy(inverse(frame.T_world_camera)).to(torch.float32)
        bricks = self._seen(frame, T_camera_world)
        if only is not None:
            bricks = bricks[only.index_select(0, bricks // BRICKS)]
        self._update(bricks, frame, gain, T_camera_world)
        self._frames += 1
        if self._frames % RELEASE_FRAMES == 0:
            self.release()
        return torch.unique_consecutive(bricks // BRICKS).numpy()

    def clear(self, blocks: Tensor) -> None:
        """Forget what is known of the blocks that are marked (B,)."""
        numbers = torch.nonzero(blocks)[:, 0]
        bricks = (numbers[:, None] * BRICKS + torch.arange(BRICKS)).reshape(-1)
        for table in self._tables.values():
            table.rows.index_fill_(0, bricks, 0)

    def _make_blocks(self, frame: DepthFrame) -> None:
        """Make the blocks around the surface that the frame saw."""
        camera, edge_m = self._camera, EDGE * self.voxel_m
        farthest_m = max(float(frame.pixels[:, Z].max()), NEAREST_M)
        step = int(np.clip(0.5 * edge_m * camera.fx / farthest_m, 1, MAX_RAY_STEP_PX))
        pixel, rays = self._rays(frame, step)
        known = frame.pixels[pixel]
        T = torch.from_numpy(frame.T_world_camera).to(torch.float32)
        keys = []
        for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
            reach = known[:, BEHIND] if share > 0 else FRONT_VOXELS * self.voxel_m
            points = rays * (known[:, Z] + share * reach)[:, None] @ T[:3, :3].T + T[:3, 3]
            keys.append(block_keys(torch.floor(points / edge_m).to(torch.int64)))
        new = [k for k in torch.unique(torch.cat(keys)).tolist() if k not in self._number]
        self._reserve(len(self) + len(new))
        self._add_blocks(new)

    def _add_blocks(self, keys: list[int]) -> None:
        """Number new blocks, for which there is room."""
        first = len(self)
        self._number.update(zip(keys, range(first, first + len(keys)), strict=True))
        indices = block_indices(torch.tensor(keys, dtype=torch.int64))
        self._origin[first : len(self)] = indices.to(torch.float32) * (EDGE * self.voxel_m)

    def _rays(self, frame: DepthFrame, step: int) -> tuple[Tensor, Tensor]:
        """Every ``step``-th pixel (N,) that tells something, and its ray (N, 3) with z = 1."""
        camera = self._camera
        image = frame.pixels[:, WEIGHT].reshape(camera.height, camera.width)
        v, u = torch.nonzero(image[::step, ::step]).mul_(step).unbind(-1)
        rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
        return v * camera.width + u, torch.nn.functional.pad(rays, (0, 1), value=1)

    def _gain(self, frame: DepthFrame) -> Tensor:
        """Factors (3,) of red, green and blue that give a frame the exposure of the surface."""
        step = max(int(np.sqrt(len(frame.pixels) / SAMPLES)), 1)
        pixel, rays = self._rays(frame, step)
        T = torch.from_numpy(frame.T_world_camera).to(torch.float32)
        points = rays * frame.pixels[pixel, Z, None] @ T[:3, :3].T + T[:3, 3]
        return gains(frame.paint[pixel, :3], self.colours_at(points))

    def colours_at(self, points_world: Tensor) -> Tensor:
        """Colours (N, 3) of the voxels at points (N, 3), and their weights: (N, 4)."""
        keys, row = voxel_places(torch.floor(points_world / self.voxel_m + 0.5).to(torch.int64))
        keys, which = torch.unique(keys, return_inverse=True)
        numbers = [self._number.get(k, -1) for k in keys.tolist()]
        number = torch.tensor(numbers, dtype=torch.int64)[which]
        row += number.clamp(min=0) * (BRICKS * BRICK_VOXELS)
        return self.colour.view(-1, 4)[row].to(torch.float32) * (number >= 0)[:, None]

    def _reserve(self, blocks: int) -> None:
        """Let the tables hold so many blocks."""
        held = len(self._origin)
        if blocks <= held:
            return
        blocks = max(blocks, held * 3 // 2)
        origin, self._origin = self._origin, torch.zeros((blocks, 3))
        self._origin[:held] = origin
        for name, table in self._tables.items():
            table.grow(blocks * BRICKS)
            setattr(self, name, table.rows)

    def _seen(self, frame: DepthFrame, T_camera_world: Tensor) -> Tensor:
        """Numbers (N,) of the bricks that are at a surface of the frame or in front of it."""
        edge_m, brick_m = EDGE * self.voxel_m, BRICK * self.voxel_m
        R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
        centres = (self._origin[: len(self)] + 0.5 * edge_m) @ R.T + t
        blocks = torch.nonzero(self._in_image(centres, edge_m)[1])[:, 0]
        corners = (self._origin[blocks][:, None] + self._bricks).reshape(-1, 3)
        centres = (corners + 0.5 * brick_m) @ R.T + t
        pixel, inside = self._in_image(centres, brick_m)
        plane = frame.pixels.index_select(0, pixel)
        d = (plane[:, NX : NZ + 1] * centres).sum(1) - plane[:, OFFSET]
        near = d > -plane[:, BEHIND] - brick_m - 0.01 * centres[:, 2]
        before = centres[:, 2] < frame.free_m.index_select(0, pixel)
        numbers = (blocks[:, None] * BRICKS + torch.arange(BRICKS)).reshape(-1)
        return numbers[inside & (near & (plane[:, WEIGHT] > 0) | before)]

    def _in_image(self, centres: Tensor, edge_m: float) -> tuple[Tensor, Tensor]:
        """Pixels (N,) of cubes around points (N, 3) of the camera, the nearest of the image's, and
        whether some of the cube is in the image.
        """
        camera, z = self._camera, centres[:, 2].clamp(min=NEAREST_M)
        margin = 0.87 * edge_m * camera.fx / z
        u = centres[:, 0] / z * camera.fx + camera.cx
        v = centres[:, 1] / z * camera.fy + camera.cy
        inside = (u > -margin) & (u < camera.width - 1 + margin) & (centres[:, 2] > NEAREST_M)
        inside &= (v > -margin) & (v < camera.height - 1 + margin)
        u, v = u.round_().clamp_(0, camera.width - 1), v.round_().clamp_(0, camera.height - 1)
        return v.mul_(camera.width).add_(u).to(torch.int64), inside

    def _update(
        self, bricks: Tensor, frame: DepthFrame, gain: Tensor, T_camera_world: Tensor
    ) -> None:
        """Add what the frame, its colours times a gain (3,), tells of the voxels of bricks (N,)."""
        R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
        corners = (self._origin[bricks // BRICKS] + self._bricks[bricks % BRICKS]) @ R.T + t
        camera, voxel_m = self._camera, self.voxel_m
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        reach = (voxel_m, FRONT_VOXELS * voxel_m, COLOUR_VOXELS * voxel_m, 1 - FREE_SHARE)
        bits = (t.numpy().view(np.uint16) for t in (self.witnesses, self.free, self.colour))
        images = (t.numpy() for t in (frame.pixels, frame.free_m, frame.paint))
        add_frame(
            bricks.numpy(),
            (corners.numpy(), (self._voxels @ R.T).numpy()),
            (*map(np.float32, intrinsics), camera.width, camera.height),
            (*images, tuple(map(np.float32, gain.tolist()))),
            tuple(map(np.float32, reach)),
            (self.distance.numpy(), self.weight.numpy(), *bits),
        )
