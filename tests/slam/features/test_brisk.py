"""Keypoints of a rendered plane: bucketing, depth, sigmas, empty images."""

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic_view import CAMERA, PLANE_Z_M, render_plane

from bmask_slam.features.brisk import (
    BriskExtractor,
    FeatureConfig,
    Features,
    joined,
    spread_order,
)
from bmask_slam.features.keypoint_depth import sample_depth
from bmask_slam.features.matching import hamming
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import KINECT_DISPARITY_SIGMA_PX, Camera, DepthNoise
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, se3_exp, so3_exp
from bmask_slam.sequences.frame import Frame

RNG = np.random.default_rng(4)
CONFIG = FeatureConfig()
FRONTAL = render_plane(np.eye(4))
FREIBURG1 = Camera(
    640,
    480,
    fx=517.306408,
    fy=516.469215,
    cx=318.643040,
    cy=255.313989,
    distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
)


def extract(frame: Frame, config: FeatureConfig = CONFIG, camera: Camera = CAMERA) -> Features:
    return BriskExtractor(camera, config).extract(frame)


def arrays(features: Features) -> dict[str, np.ndarray]:
    return {f.name: getattr(features, f.name) for f in dataclasses.fields(features)}


def test_columns_agree_in_shape_and_type() -> None:
    features = extract(FRONTAL)
    n = len(features)
    assert n > 300
    assert features.descriptors.shape == (n, 8)
    assert features.descriptors.dtype == np.uint64
    assert features.pixels.shape == features.image_pixels.shape == (n, 2)
    assert features.sigmas_px.shape == features.measurements.shape == (n, 3)
    assert features.colours.shape == (n, 3)
    assert features.gray.shape == (480, 640)
    assert (features.scales >= 1).all()
    assert np.isfinite(features.pixels).all()


def test_the_same_frame_gives_the_same_arrays() -> None:
    extractor = BriskExtractor(CAMERA, CONFIG)
    first = extractor.extract(FRONTAL)
    extractor.extract(render_plane(se3_exp(np.array([0.1, 0, 0, 0, 0, 0.3]))))
    for other in (extractor.extract(FRONTAL), extract(FRONTAL)):
        for name, values in arrays(first).items():
            np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)


def corners(gray: Image, thresholds: tuple[int, ...], enough: int) -> list[Any]:
    """FAST's, 40 px inside the image, at the first threshold with enough, or the last."""
    inside = np.zeros_like(gray)
    inside[40:-40, 40:-40] = 255
    for threshold in thresholds:
        found = list(cv2.FastFeatureDetector_create(threshold).detect(gray, inside))
        if len(found) >= enough:
            break
    return found


@pytest.mark.parametrize("contrast", [1.0, 0.7, 0.5, 0.3])
def test_the_highest_threshold_with_enough_corners_is_used(contrast: float) -> None:
    """Equal to FAST at one threshold after the other, also for images with low contrast."""
    rgb = np.rint(128 + contrast * (FRONTAL.rgb.astype(float) - 128)).astype(np.uint8)
    frame = dataclasses.replace(FRONTAL, rgb=rgb)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    config = dataclasses.replace(
        CONFIG, border_px=40, bucket_px=640, max_keypoints=500, layer_shares=(1.0,)
    )
    found = corners(gray, config.thresholds, config.max_keypoints)
    best = sorted(found, key=lambda k: -k.response)[: config.max_keypoints]
    weakest = best[-1].response
    expected = {k.pt for k in found if k.response > weakest}
    pixels = {tuple(p) for p in extract(frame, config).image_pixels.tolist()}
    assert expected <= pixels <= {k.pt for k in found if k.response >= weakest}


@pytest.mark.parametrize("contrast", [0.22, 0.15])
def test_in_a_dark_image_lower_thresholds_are_used(contrast: float) -> None:
    """The highest of them at which there are enough for a pose; none if a few are found anyway."""
    rgb = np.rint(20 + contrast * FRONTAL.rgb.astype(float)).astype(np.uint8)
    frame = dataclasses.replace(FRONTAL, rgb=rgb)
    config = dataclasses.replace(CONFIG, border_px=40, bucket_px=640, layer_shares=(1.0,))
    without = extract(frame, dataclasses.replace(config, faint_thresholds=()))
    assert len(without) < config.few_corners
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    found = corners(gray, config.faint_thresholds, config.few_corners)
    assert len(extract(frame, config)) == min(len(found), config.max_keypoints) > len(without)
    enough = dataclasses.replace(config, few_corners=len(without))
    assert len(extract(frame, enough)) == len(without)


@pytest.mark.parametrize("layer", [0, 1])
def test_descriptors_equal_opencvs_at_the_same_keypoints(layer: int) -> None:
    """Each descriptor is that of its pixel and angle in its layer."""
    features = extract(FRONTAL, dataclasses.replace(CONFIG, layer_shares=(0.5, 0.5)))
    rows = features.scales == 2.0**layer
    gray = features.gray if layer == 0 else cv2.pyrDown(features.gray)
    places = features.image_pixels[rows] / 2.0**layer
    keypoints = [
        cv2.KeyPoint(float(u), float(v), 12.0, float(np.rad2deg(a)))
        for (u, v), a in zip(places, features.angles_rad[rows], strict=True)
    ]
    kept, expected = cv2.BRISK_create().compute(gray, keypoints)
    assert len(kept) == rows.sum() > 150
    distance = hamming(features.descriptors[rows], expected.view(np.uint64))
    assert np.median(distance) <= 8
    assert np.percentile(distance, 99) < 60


@pytest.mark.parametrize("cap", [50, 200])
def test_keypoints_are_capped_and_spread(cap: int) -> None:
    few = extract(FRONTAL, dataclasses.replace(CONFIG, max_keypoints=cap))
    assert 0.75 * cap <= len(few) <= cap  # BRISK cannot describe some at the border
    quarter = (few.image_pixels > [320, 240]) @ [1, 2]
    assert np.bincount(quarter, minlength=4).min() > cap / 8


def test_one_textured_corner_does_not_get_all_keypoints() -> None:
    """Strong texture in one quarter, weak elsewhere: weak keypoints are still chosen."""
    weak = np.rint(128 + 0.6 * (FRONTAL.rgb.astype(float) - 128)).astype(np.uint8)
    weak[:240, :320] = FRONTAL.rgb[:240, :320]
    config = dataclasses.replace(CONFIG, thresholds=(15,), max_keypoints=190)
    features = extract(dataclasses.replace(FRONTAL, rgb=weak), config)
    rich = (features.image_pixels < [320, 240]).all(axis=1)
    assert rich.mean() < 0.35


def slow_spread_order(bucket: list[int], score: list[float]) -> list[int]:
    """In rounds: the best remaining keypoint of every bucket; within a round by score."""
    left = sorted(range(len(bucket)), key=lambda i: -score[i])
    order = []
    while left:
        served: set[int] = set()
        for i in list(left):
            if bucket[i] not in served:
                served.add(bucket[i])
                order.append(i)
                left.remove(i)
    return order


@pytest.mark.parametrize("count", [0, 1, 2, 60])
def test_spread_order_visits_buckets_in_rounds(count: int) -> None:
    bucket, score = RNG.integers(0, 9, count), RNG.permutation(count).astype(float)
    order = spread_order(bucket, score)
    assert order.tolist() == slow_spread_order(bucket.tolist(), score.tolist())


def test_depth_and_disparity_of_a_plane() -> None:
    features = extract(FRONTAL)
    np.testing.assert_allclose(features.depth_m, PLANE_Z_M, rtol=1e-6)
    np.testing.assert_allclose(features.disparity_px, CAMERA.stereo_bf_px_m / PLANE_Z_M, rtol=1e-6)
    stereo = CAMERA.project_stereo(CAMERA.backproject(features.pixels, features.depth_m))
    np.testing.assert_allclose(features.measurements[:, :2], stereo[:, :2], atol=1e-9)
    np.testing.assert_allclose(features.measurements[:, 2], stereo[:, 0] - stereo[:, 2], atol=1e-9)


def test_sigmas_grow_with_the_square_root_of_scale() -> None:
    frontal = extract(FRONTAL, dataclasses.replace(CONFIG, layer_shares=(0.7, 0.3)))
    np.testing.assert_allclose(frontal.sigmas_px[:, 2], KINECT_DISPARITY_SIGMA_PX, rtol=1e-3)
    np.testing.assert_array_equal(frontal.sigmas_px[:, 0], frontal.sigmas_px[:, 1])
    expected = CONFIG.pixel_sigma * np.sqrt(frontal.scales)
    np.testing.assert_allclose(frontal.sigmas_px[:, 0], expected, rtol=1e-12)
    assert frontal.scales.max() > 1.5
    assert frontal.sigmas_px[:, 0].min() == pytest.approx(CONFIG.pixel_sigma)


@pytest.mark.parametrize(
    "noise", [DepthNoise(0.01), DepthNoise(b=0.004), DepthNoise(0.0015, -0.0015, 0.0019)]
)
def test_disparity_sigma_is_that_of_the_cameras_depth(noise: DepthNoise) -> None:
    """Depths off by one sigma have disparities off by one sigma."""
    camera = dataclasses.replace(CAMERA, depth_noise=noise)
    features = extract(FRONTAL, camera=camera)
    sigma_m = noise.a_m + noise.b * PLANE_Z_M + noise.c_per_m * PLANE_Z_M**2
    off_m = PLANE_Z_M + 0.01 * sigma_m
    off_px = 100 * CAMERA.stereo_bf_px_m * (1 / PLANE_Z_M - 1 / off_m)
    np.testing.assert_allclose(features.sigmas_px[:, 2], off_px, rtol=0.01)
    set_by_hand = dataclasses.replace(CONFIG, disparity_sigma_px=0.3)
    features = extract(FRONTAL, set_by_hand, camera)
    np.testing.assert_allclose(features.sigmas_px[:, 2], 0.3, rtol=1e-3)


def test_disparity_sigma_of_a_slanted_plane_has_the_depth_change_of_a_pixel() -> None:
    """The quartiles of a 5 by 5 window lie one column either side of its middle."""
    turned = so3_exp(np.array([0, np.deg2rad(50), 0]))
    frame = render_plane(make_pose(turned, np.array([-1.0, 0.0, 1.2])))
    features = extract(frame)
    finite = np.isfinite(features.depth_m)
    assert finite.sum() > 50
    columns, rows = np.rint(features.image_pixels[finite]).astype(int).T
    slope_m = (frame.depth_m[rows, columns + 1] - frame.depth_m[rows, columns - 1]) / 2
    change_px = CAMERA.stereo_bf_px_m / features.depth_m[finite] ** 2 * slope_m
    expected = np.hypot(KINECT_DISPARITY_SIGMA_PX, change_px)
    assert expected.max() > 1.05 * KINECT_DISPARITY_SIGMA_PX
    np.testing.assert_allclose(features.sigmas_px[finite, 2], expected, rtol=0.01)


def test_image_pixels_are_distorted_pixels() -> None:
    coloured = FRONTAL.rgb.copy()
    coloured[..., 1] = np.clip(coloured[..., 1].astype(int) + 7, 0, 255)
    features = extract(dataclasses.replace(FRONTAL, rgb=coloured))
    for (u, v), colour in zip(features.image_pixels[:50], features.colours[:50], strict=True):
        assert colour.tolist() == coloured[round(v), round(u)].tolist()


def test_no_keypoint_without_a_valid_pixel() -> None:
    for features in (extract(FRONTAL), extract(FRONTAL, camera=FREIBURG1)):
        assert (features.image_pixels > 0).all()
        assert (features.image_pixels < [639, 479]).all()


@pytest.mark.parametrize("value", [0, 128, 255])
def test_an_empty_image_has_no_features(value: int) -> None:
    frame = dataclasses.replace(FRONTAL, rgb=np.full((480, 640, 3), value, np.uint8))
    for camera in (CAMERA, FREIBURG1):
        features = extract(frame, camera=camera)
        assert len(features) == 0
        assert features.descriptors.shape == (0, 8)
        assert features.measurements.shape == features.sigmas_px.shape == (0, 3)
        assert features.colours.shape == (0, 3)


def test_without_depth_features_are_monocular() -> None:
    frame = dataclasses.replace(FRONTAL, depth_m=np.full((480, 640), np.nan, np.float32))
    features = extract(frame)
    assert len(features) > 300
    assert np.isnan(features.depth_m).all()
    assert np.isnan(features.measurements[:, 2]).all()
    assert np.isfinite(features.sigmas_px[:, :2]).all()


def test_no_keypoints_in_covered_parts() -> None:
    camera = dataclasses.replace(CAMERA, covered=((0, 300, 640, 480), (100, 0, 200, 120)))
    extractor = BriskExtractor(camera, dataclasses.replace(CONFIG, layer_shares=(0.7, 0.3)))
    features = extractor.extract(FRONTAL)
    columns, rows = np.rint(features.image_pixels).astype(int).T
    assert len(features) > 300 and camera.visible(7)[rows, columns].all()
    more = extractor.reserve(FRONTAL, features, 0.5)
    columns, rows = np.rint(more.image_pixels).astype(int).T
    assert len(more) and camera.visible(7)[rows, columns].all()
    places = np.array([[150.0, 60.0], [320.0, 200.0], [320.0, 400.0]])
    assert extractor.at(FRONTAL, features.gray, places)[0].tolist() == [1]


def noisy_wall(share: float) -> np.ndarray:
    """A wall at 2 m, and beside it one at 2.6 m, with noise of this share of the depth."""
    depth = np.full((480, 640), 2.0)
    depth[:, 400:] = 2.6
    return depth * (1 + share * np.random.default_rng(3).normal(size=depth.shape))


@pytest.mark.parametrize("share", [0.001, 0.015, 0.03])
def test_noise_of_the_whole_image_is_no_depth_edge(share: float) -> None:
    v, u = np.mgrid[20:460:10, 20:620:7]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    depth_m, _ = sample_depth(noisy_wall(share).astype(np.float32), pixels, CONFIG)
    at_edge = np.abs(pixels[:, 0] - 399.5) < CONFIG.depth_window_px
    assert np.isfinite(depth_m[~at_edge]).mean() > 0.9
    assert np.isnan(depth_m[at_edge]).all()


def depth_at(depth: np.ndarray, u: float, v: float) -> tuple[float, float]:
    depth_m, spread_m = sample_depth(depth.astype(np.float32), np.array([[u, v]]), CONFIG)
    return float(depth_m[0]), float(spread_m[0])


def test_depth_is_looked_up_at_row_v_column_u() -> None:
    depth = np.full((480, 640), 1.0)
    depth[90:111, 190:211] = 2.0
    assert depth_at(depth, 200.4, 99.6)[0] == 2.0
    assert depth_at(depth, 99.6, 200.4)[0] == 1.0


def test_depth_is_rejected_at_an_edge_and_kept_beside_it() -> None:
    depth = np.full((480, 640), 1.0)
    depth[:, 300:] = 1.5
    reach = CONFIG.depth_window_px
    for u in range(290, 311):
        straddles = u - reach < 300 <= u + reach
        assert np.isnan(depth_at(depth, u, 100)[0]) == straddles, u


def test_depth_tolerates_a_small_step_in_proportion_to_depth() -> None:
    for z, step, good in ((1.0, 0.035, True), (1.0, 0.045, False), (3.0, 0.1, True)):
        depth = np.full((480, 640), z)
        depth[:, 300:] = z + step
        assert np.isfinite(depth_at(depth, 300, 100)[0]) == good


def test_depth_needs_half_of_the_window() -> None:
    side = 2 * CONFIG.depth_window_px + 1
    for missing, good in ((side**2 // 2, True), (side**2 // 2 + 1, False), (side**2, False)):
        depth = np.full((480, 640), 1.25)
        window = np.full(side**2, 1.25)
        window[RNG.permutation(side**2)[:missing]] = np.nan
        reach = CONFIG.depth_window_px
        depth[100 - reach : 101 + reach, 200 - reach : 201 + reach] = window.reshape(side, side)
        assert np.isfinite(depth_at(depth, 200, 100)[0]) == good, missing


def test_missing_depth_may_be_0_as_of_features_that_are_made_ahead() -> None:
    depth, pixels = np.full((20, 20), np.nan, np.float32), np.array([[10.0, 10.0], [7.0, 7.0]])
    depth[8:12, 8:13] = 2.0
    nan, zero = (sample_depth(image, pixels, CONFIG) for image in (depth, np.nan_to_num(depth)))
    np.testing.assert_array_equal(zero, nan)
    assert np.isfinite(nan[0]).tolist() == [True, False]


def test_depth_is_the_median_and_the_spread_of_the_valid() -> None:
    depth = 1.0 + 0.01 * RNG.random((480, 640))
    depth[100, 201] = np.nan
    reach = CONFIG.depth_window_px
    window = depth[100 - reach : 101 + reach, 200 - reach : 201 + reach]
    depth_m, spread_m = depth_at(depth, 200, 100)
    assert depth_m == pytest.approx(np.nanmedian(window), abs=1e-3)
    low, high = np.nanpercentile(window, [25, 75])
    assert spread_m == pytest.approx((high - low) / 2, rel=0.35)


@pytest.mark.parametrize(("z", "good"), [(0.2, False), (0.31, True), (7.9, True), (8.1, False)])
def test_depth_has_a_range(z: float, good: bool) -> None:
    assert np.isfinite(depth_at(np.full((480, 640), z), 200, 100)[0]) == good


def test_depth_at_image_corners_and_of_no_keypoints() -> None:
    depth = np.full((480, 640), 1.0, np.float32)
    corners = np.array([[0.0, 0.0], [639.0, 479.0], [639.0, 0.0]])
    np.testing.assert_array_equal(sample_depth(depth, corners, CONFIG)[0], 1.0)
    assert len(sample_depth(depth, np.zeros((0, 2)), CONFIG)[0]) == 0


def test_the_reserve_equals_the_rest_of_a_larger_search() -> None:
    config = dataclasses.replace(CONFIG, max_keypoints=200, layer_shares=(1.0,))
    extractor = BriskExtractor(CAMERA, config)
    features = extractor.extract(FRONTAL)
    reserve = extractor.reserve(FRONTAL, features, 0.5)
    larger = extract(FRONTAL, dataclasses.replace(config, max_keypoints=400))
    both = joined(features, extractor.described(reserve))
    places = {tuple(p) for p in both.image_pixels.tolist()}
    assert len(places) == len(both) == len(features) + len(reserve)
    assert {tuple(p) for p in larger.image_pixels.tolist()} <= places
    expected = {tuple(p): k for k, p in enumerate(larger.image_pixels.tolist())}
    rows = np.array([expected.get(tuple(p), -1) for p in both.image_pixels.tolist()])
    for name in ("descriptors", "angles_rad", "depth_m", "sigmas_px", "pixels", "colours"):
        common, others = getattr(both, name)[rows >= 0], getattr(larger, name)[rows[rows >= 0]]
        # sums over a patch are rounded by how many patches some processors take at once
        np.testing.assert_allclose(common, others, rtol=1e-5 * (name == "angles_rad"), err_msg=name)


@pytest.mark.parametrize("shares", [(), (0.7, 0.7), (1.0, -0.1), (0.2,) * 5])
def test_shares_of_layers_are_checked(shares: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="layer_shares"):
        dataclasses.replace(CONFIG, layer_shares=shares)
