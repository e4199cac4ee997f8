"""The smoother's settings, apart from its class so that they can be read without GTSAM."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SmootherConfig:
    """Settings of `graph.smoother.smoother.Smoother`.

    Attributes:
        relinearize_threshold: change of a variable (rad, m) above which ISAM2 linearises anew. At
            0.01 what is neglected is some hundredths of a pixel.
        relinearize_skip: ISAM2 looks for such variables every so many updates.
        extra_iterations: further ISAM2 updates without new factors after each update.
        robust: Huber's kernel on observations; without, factors are plain Gaussian.
        huber_stereo, huber_mono: where the kernel starts, in standard deviations: the square
            roots of the 95 % chi-square bounds with 3 and 2 degrees of freedom.
        robust_pose_k: the same for a relative pose with a kernel (6 degrees).
        gate_sigmas: an observation whose reprojection error at the initial values is larger
            is refused. Generous: a landmark observed once has a depth sigma of z^2/bf pixels of
            disparity noise, which from 30 degrees aside is tens of pixels; Huber does the rest.
        max_disparity_ratio: a stereo observation of a new landmark whose disparity is more
            than so many times that of the initial values is refused: at 2 a Gauss-Newton step
            moves the landmark behind the camera, z (2 - d_measured / d).
        min_depth_m, max_range_m: allowed z-depth of an observed landmark.
        min_parallax_deg: angle between two viewing rays that a landmark without any stereo
            observation needs.
        min_shared_observations: landmarks of the graph that a new keyframe without a prior or
            relative pose must observe.
        min_left_observations: the same after a removal. Larger, since what is left may lie in
            one part of the image, about which the camera can turn with little error.
        prior_sigma_rotation_rad, prior_sigma_translation_m: of the prior on the first pose.
        anchor_sigma_rotation_rad, anchor_sigma_translation_m: of the weak between factor that
            holds a keyframe which a removal left underconstrained.
        marginal_keyframes: landmarks that are marginalised in one update are split into groups
            observed by at most so many keyframes; each group becomes relative poses of its own.
        base_share: a keyframe that shares a smaller part of its marginalised landmarks with any
            base becomes one (`graph.marginals.sparsification`).
        least_decrease: relative decrease of the cost in an iteration below which an optimisation of
            the whole graph ends. Below it outliers creep on for a hundred iterations.
        max_repairs: attempts to rebuild after failures before the update is given up.
    """

    relinearize_threshold: float = 0.01
    relinearize_skip: int = 1
    extra_iterations: int = 0
    robust: bool = True
    huber_stereo: float = math.sqrt(7.815)
    huber_mono: float = math.sqrt(5.991)
    robust_pose_k: float = math.sqrt(12.592)
    gate_sigmas: float = 100.0
    max_disparity_ratio: float = 1.7
    min_depth_m: float = 0.05
    max_range_m: float = 60.0
    min_parallax_deg: float = 1.0
    min_shared_observations: int = 6
    min_left_observations: int = 15
    prior_sigma_rotation_rad: float = 1e-4
    prior_sigma_translation_m: float = 1e-4
    anchor_sigma_rotation_rad: float = 0.05
    anchor_sigma_translation_m: float = 0.1
    marginal_keyframes: int = 24
    base_share: float = 0.25
    least_decrease: float = 1e-5
    max_repairs: int = 10

    def __post_init__(self) -> None:
        if self.relinearize_skip < 1:  # GTSAM divides by it, which ends the process
            raise ValueError(f"relinearize_skip = {self.relinearize_skip}: must be at least 1")
