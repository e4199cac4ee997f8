"""A volume whose frames move: a loop, removed frames, exposure, and tables in files."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from surface_scene import CAMERA, as_map, plane_rho, poses

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.files.array_file import write_arrays
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.surface.blocks import block_keys
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame
from bmask_slam.mapping.surface.extraction import Surface, extract
from bmask_slam.mapping.surface.following import (
    VOLUME_FILE,
    FollowingSurface,
    displacement_m,
    read_kept,
)
from bmask_slam.mapping.surface.parts import BLOCKS, as_part, extract_region, regions_of
from bmask_slam.mapping.surface.volume import SurfaceVolume

VOXEL_M, WALL_M, ERROR_M = 0.05, 2.0, 0.1
BACK = np.diag([-1.0, 1.0, -1.0, 1.0])
AHEAD = poses(np.random.default_rng(3), 5)
BEHIND = [BACK @ T for T in AHEAD]
TRUE = dict(enumerate([*AHEAD[:3], *BEHIND, *AHEAD[3:]]))
"""Out, around, and back to where it began."""
DRIFT = np.array([0.0, 0.0, ERROR_M])


def drifted(number: int) -> Array:
    """The error has grown to 10 cm when the start is seen again; a loop removes it."""
    T = TRUE[number].copy()
    T[:3, 3] += DRIFT * (0, 0, 0, 0, 0, 0, 0, 0.5, 1, 1)[number]
    return T


def seen_from(number: int, T_estimated: Array, colour: int = 100) -> DepthFrame:
    """What the true camera sees of walls at z = 2 m and -2 m, placed where it is believed."""
    side = np.sign(TRUE[number][2, 2])
    rho = plane_rho(TRUE[number], (0.0, 0.0, side), WALL_M)
    rgb = np.full((30, 40, 3), colour, np.uint8)
    return depth_frame(as_map(rho, 0.002), rgb, T_estimated, CAMERA, VOXEL_M)


def scratch(poses_of: dict[int, Array]) -> Surface:
    volume = SurfaceVolume(VOXEL_M, CAMERA)
    for number, T in poses_of.items():
        volume.integrate(seen_from(number, T))
    return extract(volume)


def off_m(surface: Surface) -> float:
    return float(np.quantile(np.abs(np.abs(surface.vertices[:, 2]) - WALL_M), 0.9))


def test_a_loop_that_corrects_ten_centimetres_moves_the_surface() -> None:
    read: list[int] = []

    def load(number: int, T: Array) -> DepthFrame:
        read.append(number)
        return seen_from(number, T)

    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA, blocks=8), load)
    for number in TRUE:
        surface.add(number, seen_from(number, drifted(number)))
    assert off_m(extract(surface.volume)) > 0.03
    assert surface.follow(TRUE) == len(read)
    corrected, expected = extract(surface.volume), scratch(TRUE)
    assert off_m(corrected) < 0.002
    assert len(corrected.vertices) == len(expected.vertices)
    np.testing.assert_allclose(corrected.vertices, expected.vertices, atol=1e-4)
    np.testing.assert_allclose(corrected.weights, expected.weights, rtol=1e-3)
    np.testing.assert_array_equal(corrected.views, expected.views)
    assert read == sorted(read)
    assert set(read) >= {0, 1, 2, 8, 9}
    assert surface.follow(TRUE) == 0


def test_parts_of_all_regions_are_the_whole_surface() -> None:
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    for number, T in TRUE.items():
        surface.add(number, seen_from(number, T))
    whole = extract(surface.volume)
    corners = np.zeros((0, 3, 6))
    for region in regions_of(surface.take_changed()):
        part = extract_region(surface.volume, region)
        corners = np.concatenate([corners, corners_of(part)])
        given = as_part(region, part, 2 * VOXEL_M)
        assert len(given.vertices) < 0.6 * len(part.vertices) or not len(part.vertices)
        assert np.abs(np.abs(given.vertices[:, 2]) - WALL_M).max(initial=0) < 0.002
    assert not len(surface.take_changed())
    one, other = (c.reshape(len(c), -1) for c in (corners, corners_of(whole)))
    one, other = (c[np.lexsort(c.T)] for c in (one, other))
    np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize(
    ("block", "count"), [((3, 3, 3), 1), ((7, 3, 3), 2), ((0, 3, -8), 4), ((-1, 8, 15), 8)]
)
def test_a_block_changes_every_region_that_it_is_beside(
    block: tuple[int, int, int], count: int
) -> None:
    found = regions_of(block_keys(torch.tensor([block])).numpy())
    low = BLOCKS * np.array(sorted(found))
    assert len(found) == count
    assert ((low - 1 <= block) & (block <= low + BLOCKS)).all()


def corners_of(surface: Surface) -> Array:
    """Places and normals (M, 3, 6) of the triangles' corners."""
    both = np.concatenate([surface.vertices, surface.normals], axis=1).astype(float)
    return np.round(both[surface.triangles], 4)


def test_following_in_steps_takes_frames_between_them() -> None:
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    for number in range(9):
        surface.add(number, seen_from(number, drifted(number)))
    surface.take_changed()
    steps = surface.following({n: TRUE[n] for n in range(9)})
    while not next(steps)[1]:
        pass
    assert surface.stale.any()
    surface.add(9, seen_from(9, TRUE[9]))
    assert sum(was_read for _, was_read in steps) > 0
    assert not surface.stale.any()
    assert len(surface.take_changed())
    expected, found = scratch(TRUE), extract(surface.volume)
    np.testing.assert_allclose(np.sort(found.views), np.sort(expected.views))
    assert off_m(found) < 0.002


def test_only_what_saw_changed_blocks_is_read_again() -> None:
    read: list[int] = []

    def load(number: int, T: Array) -> DepthFrame:
        read.append(number)
        return seen_from(number, T)

    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), load)
    for number, T in TRUE.items():
        surface.add(number, seen_from(number, T))
    surface.follow({9: drifted(9), 8: TRUE[8]})
    assert read == [0, 1, 2, 8, 9]


def test_a_removed_frame_leaves_no_trace() -> None:
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    for number in TRUE:
        surface.add(number, seen_from(number, drifted(number)))
    surface.follow({}, removed=[7, 8, 9])
    assert 9 not in surface
    left = extract(surface.volume)
    assert np.abs(np.abs(left.vertices[:, 2]) - WALL_M).max() < 0.002
    assert left.views.max() == 4  # of those that look back


def test_a_moved_frame_may_make_blocks_in_view_of_others() -> None:
    """It comes to look as if there were a wall 1 m nearer, in front of the other's."""
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    for number in (0, 1):
        surface.add(number, seen_from(number, TRUE[number]))
    before, nearer = len(surface.volume), TRUE[0].copy()
    nearer[2, 3] -= 1.0
    assert surface.follow({0: nearer, 1: TRUE[1]}) == 2
    assert len(surface.volume) > before
    left = extract(surface.volume, 1).vertices[:, 2]
    assert np.mean(np.abs(left - WALL_M) < 0.01) > 0.4


def test_blocks_that_came_after_a_frame_are_cleared_of_it_too() -> None:
    """Frame 0 makes blocks before frame 1's wall and leaves them to it; then that is removed."""
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    for number in (0, 1):
        surface.add(number, seen_from(number, TRUE[number]))
    nearer, elsewhere = TRUE[0].copy(), BACK @ TRUE[0]
    nearer[2, 3] -= 1.0
    elsewhere[0, 3] += 50.0
    surface.follow({0: nearer, 1: TRUE[1]})
    surface.follow({0: elsewhere, 1: TRUE[1]})
    surface.follow({}, removed=[1])
    surface.follow({}, removed=[0])
    for table in (surface.volume.weight, surface.volume.free, surface.volume.witnesses):
        assert not table.any()


def test_a_frame_that_cannot_be_read_again_leaves_no_trace() -> None:
    missing: set[int] = set()

    def load(number: int, T: Array) -> DepthFrame | None:
        return None if number in missing else seen_from(number, T)

    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), load)
    for number in TRUE:
        surface.add(number, seen_from(number, drifted(number)))
    missing.add(8)  # it has blocks of its own, too
    surface.follow({9: TRUE[9]})
    assert 8 not in surface
    believed = {n: drifted(n) for n in range(8)} | {9: TRUE[9]}
    expected, found = scratch(believed), extract(surface.volume)
    np.testing.assert_array_equal(found.views, expected.views)
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-4)


def test_a_frame_without_depth_changes_nothing() -> None:
    surface = FollowingSurface(SurfaceVolume(VOXEL_M, CAMERA), seen_from)
    nothing, rgb = as_map(np.full((30, 40), np.nan), 0.002), np.zeros((30, 40, 3), np.uint8)
    empty = depth_frame(nothing, rgb, TRUE[1], CAMERA, VOXEL_M)
    surface.add(1, empty)
    assert len(surface.volume) == 0
    surface.add(0, seen_from(0, TRUE[0]))
    surface.add(2, empty)
    expected = scratch({0: TRUE[0]})
    for name, values in vars(extract(surface.volume)).items():
        np.testing.assert_array_equal(values, getattr(expected, name))


def test_a_turn_moves_what_is_far_away() -> None:
    c, s = np.cos(0.1), np.sin(0.1)
    turned = make_pose(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.zeros(3))
    assert 0.2 < displacement_m(np.eye(4), turned) < 0.3


def test_exposures_are_made_alike() -> None:
    """One wall in three frames, of which the camera made one half as bright: no step is left."""
    volume = SurfaceVolume(VOXEL_M, CAMERA)
    for number, colour in ((0, 160), (1, 80), (2, 160)):
        volume.integrate(seen_from(number, TRUE[number], colour))
    assert np.abs(extract(volume, 1).colours.astype(int) - 160).max() <= 6


def test_colours_are_found_where_they_are() -> None:
    """Of every voxel at its own centre, and not of the next."""
    volume = SurfaceVolume(VOXEL_M, CAMERA)
    volume.integrate(seen_from(0, TRUE[0]))
    volume.colour[...] = 0
    bricks, voxels = torch.nonzero(volume.weight[:, :1] > 0).unbind(-1)  # one in each brick
    volume.colour[bricks, voxels] = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float16)
    places = volume._origin[bricks // 8] + volume._bricks[bricks % 8] + volume._voxels[voxels]
    assert (volume.colours_at(places) == torch.tensor([1.0, 2.0, 3.0, 4.0])).all()
    assert (volume.colours_at(places + VOXEL_M)[:, 3] == 0).all()
    assert (volume.colours_at(places + 100.0) == 0).all()


def test_memory_that_was_given_back_is_read_again() -> None:
    volume = SurfaceVolume(VOXEL_M, CAMERA, blocks=8)
    for number, T in TRUE.items():
        volume.integrate(seen_from(number, T))
        volume.release()
    other = scratch(TRUE)
    for name, values in vars(extract(volume)).items():
        np.testing.assert_array_equal(values, getattr(other, name))


def test_a_kept_volume_that_is_not_whole_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "index"
    kept = SurfaceVolume(VOXEL_M, CAMERA, folder=tmp_path, kept=np.zeros(0, np.int64))
    before = FollowingSurface(kept, seen_from)
    before.add(0, seen_from(0, TRUE[0]))
    before.save(path, {})
    good = read_kept(path, {})
    assert good is not None
    bomb = np.frombuffer(zlib.compress(bytes(10_000_000)), np.uint8)
    broken = [
        {"keys": np.zeros_like(good["keys"])},
        {"poses": good["poses"] * np.nan},
        {"packed": good["packed"][::-1]},
        {"packed": good["packed"][:-2], "sizes": good["sizes"] - 2},
        {"packed": bomb, "sizes": np.array([len(bomb)])},
    ]
    for wrong in broken:
        write_arrays(path, VOLUME_FILE, {"made_of": {}}, {**good, **wrong})
        assert read_kept(path, {}) is None
    write_arrays(path, VOLUME_FILE, {"made_of": {}}, good)
    assert read_kept(path, {}) is not None
    for change in (lambda: (tmp_path / "weight").write_bytes(b""), (tmp_path / "weight").unlink):
        change()
        write_arrays(path, VOLUME_FILE, {"made_of": {}}, good)
        assert read_kept(path, {}) is None


def test_tables_grow_where_the_system_cannot_allocate(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on macOS."""
    monkeypatch.delattr("os.posix_fallocate")
    volume = SurfaceVolume(VOXEL_M, CAMERA, blocks=8)
    volume.integrate(seen_from(0, TRUE[0]))
    monkeypatch.undo()
    np.testing.assert_array_equal(extract(volume).vertices, scratch({0: TRUE[0]}).vertices)


def test_a_kept_volume_is_followed_from_where_it_was(tmp_path: Path) -> None:
    """As without a break; kept for something else, or broken, it is not used."""
    read: list[int] = []

    def load(number: int, T: Array) -> DepthFrame:
        read.append(number)
        return seen_from(number, T)

    def volume(keys: Ints) -> SurfaceVolume:
        return SurfaceVolume(VOXEL_M, CAMERA, blocks=8, folder=tmp_path, kept=keys)

    before = FollowingSurface(volume(np.zeros(0, np.int64)), load)
    for number in TRUE:
        before.add(number, seen_from(number, drifted(number)))
    without_break = scratch({n: drifted(n) for n in TRUE})
    before.save(tmp_path / "index", {"camera": "this"})
    kept = (tmp_path / "index").read_bytes()
    assert read_kept(tmp_path / "index", {"camera": "another"}) is None
    (tmp_path / "index").write_bytes(kept[:-9])
    assert read_kept(tmp_path / "index", {"camera": "this"}) is None
    (tmp_path / "index").write_bytes(kept)
    arrays = read_kept(tmp_path / "index", {"camera": "this"})
    assert arrays is not None
    assert not (tmp_path / "index").exists()
    after = FollowingSurface(volume(arrays["keys"]), load)
    after.restore(arrays)
    for name, values in vars(extract(after.volume)).items():
        np.testing.assert_array_equal(values, getattr(without_break, name))
    assert after.follow({9: drifted(9)}) == 0
    after.follow(TRUE)
    assert off_m(extract(after.volume)) < 0.002
    assert set(read) >= {0, 7, 8, 9}
