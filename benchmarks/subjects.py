"""Which code of the system makes the figures of which benchmark.

A benchmark measures its subject, and its figures are stale when the subject is another today. What
it merely uses on the way does not count: the dense map's figures are not about tracking. Every
module belongs to a group, or to `UNMEASURED`: no figure of README.md or docs/ depends on it.
Patterns are those of `pathlib.Path.glob`, from the root of the repository.
"""

from __future__ import annotations


def _of(package: str, names: str) -> tuple[str, ...]:
    return tuple(f"{package}/{name}" for name in names.split())


METRICS = _of("graph", "hand_eye.py metrics.py trajectory.py") + _of(
    "slam", "evaluation/evaluation.py"
)
SMOOTHER = _of(
    "graph",
    "admission.py archive.py camera.py covariances.py factors.py gates.py geometry.py holding.py "
    "iteration.py keys.py marginalisation.py noise.py pruning.py recovery.py retirement.py "
    "shadow.py smoother.py smoother_config.py solver.py sparsification.py support.py updates.py",
)
LOOPS = _of("graph", "loop_*.py") + _of("slam", "loop_*.py place_recognition.py")
ODOMETRY = _of(
    "slam",
    "depth_regions.py description.py features.py frame.py graph_feed.py history.py keyframes.py "
    "landmarks.py local_mapping.py localiser.py map_pruning.py mapper.py matching.py "
    "pose_optimisation.py relocalisation.py reprojection.py results.py rolling_shutter.py "
    "segments.py subpixel.py system.py system_config.py tracker.py triangulation.py world_map.py",
)
POSE_GRAPHS = _of("graph", "pose_graph*.py graduation.py g2o.py g2o_lines.py")
CALIBRATION = _of("graph", "calibration*.py") + _of(
    "slam", "calibrate.py calibration_motion.py calibration_rounds.py calibration_views.py"
)
STATE = _of("graph", "archive_storage.py array_file.py storage.py") + _of(
    "slam", "checkpoint.py map_state.py run_options.py"
)
WEIGHTS = ("data/weights/light.safetensors",)
NETWORK = _of(
    "semantics",
    "checkpoints.py detections.py evaluation.py network/*.py network_segmenter.py yolox.py",
)
TRAINING = _of("semantics", "training/*.py")
LABELS = (
    *_of(
        "semantics",
        "boxes3d.py instances.py label_store.py labels.py mask_order.py object*.py upright.py "
        "votes.py",
    ),
    "slam/labelling/landmark_votes.py",
    "slam/labelling/landmark_visibility.py",
    "slam/labelling/semantic_mapper.py",
    "data/labels/*.yaml",
)
MOVING = _of("semantics", "instance_track.py instance_tracks.py movability.py") + _of(
    "slam",
    "dynamics.py dynamics_config.py feature_check.py keyframe_masks.py refill.py stance.py "
    "static_check.py suspects.py view_memory.py witness.py",
)
DENSE = _of(
    "mapping",
    "backprojection.py cloud.py dense.py floor_plan.py fusion.py inverse_depth.py labels.py "
    "matching_cost.py mesh.py object_clouds.py pixelwise.py plane_sweep.py regularisation.py "
    "search_range.py stereo.py submaps.py warping.py",
) + _of("slam", "dense_*.py right_images.py")
LIVE = _of("slam", "live/*.py")
RENDERING = _of("slam", "rendering/*.py")
SEMANTICS = LABELS + MOVING + NETWORK + WEIGHTS

SUBJECTS = {
    "beside_torchvision.py": NETWORK,
    "calibration.py": CALIBRATION,
    "composited.py": ODOMETRY + MOVING + NETWORK + WEIGHTS + METRICS,
    "corridor_rounds.py": ODOMETRY + SMOOTHER + LOOPS + RENDERING + METRICS,
    "covariances.py": SMOOTHER,
    "dense.py": DENSE,
    "dense_pictures.py": DENSE,
    "dense_session.py": DENSE,
    "dynamic.py": ODOMETRY + RENDERING + MOVING + NETWORK + WEIGHTS + METRICS,
    "dynamic_seeds.py": ODOMETRY + RENDERING + MOVING + NETWORK + WEIGHTS + METRICS,
    "dynamic_pairs.py": (*MOVING, "slam/moving/depth_segments.py"),
    "kill_and_resume.py": STATE,
    "kitchen_reference.py": (*CALIBRATION, *METRICS),
    "label_store.py": ("semantics/beliefs/label_store.py",),
    "labels.py": RENDERING + LABELS + NETWORK + WEIGHTS,
    "live.py": ODOMETRY + LIVE,
    "live_session.py": LIVE,
    "long_session.py": SMOOTHER,
    "loop_closing.py": LOOPS + SMOOTHER + RENDERING + METRICS,
    "loop_limits.py": (
        "graph/batch/bundle_adjustment.py",
        "slam/refinement/adjustment.py",
        *METRICS,
    ),
    "no_harm.py": ODOMETRY + SEMANTICS + METRICS,
    "pose_graphs.py": POSE_GRAPHS,
    "run.py": ODOMETRY + SMOOTHER + LOOPS + RENDERING + SEMANTICS + METRICS,
    "segmentation.py": NETWORK + TRAINING + WEIGHTS,
}
"""Of each benchmark that writes into a page."""

UNMEASURED = (
    "*/__init__.py",
    "*/*/__init__.py",
    "*/*/*/__init__.py",
    *_of(
        "graph",
        "data_files.py errors.py g2o_landmarks*.py ply.py trajectory_formats.py update_report.py "
        "whole_file.py",
    ),
    *_of(
        "semantics",
        "checkpoint_names.py coco_files.py downloads.py http_file.py image_files.py mask_cache.py "
        "overlay.py ray_*.py segmenter*.py",
    ),
    *_of("mapping", "cloud_files.py depth_files.py open3d_loader.py pictures.py"),
    *_of(
        "slam",
        "__main__.py adjustment_report.py before_after.py calibration_report.py cli.py "
        "commands/*.py comparison/*.py comparison/report/*.py configuration.py covariances.py "
        "datasets/*.py evaluation/plot.py export.py landmark_cloud.py live/sources/*.py "
        "machine.py "
        "map_file.py map_localisation.py memory.py object_picture.py optimise.py "
        "optimised_map.py progress.py query.py run_folder.py run_results.py runner.py "
        "segmentation.py semantic_files.py semantic_results.py sequences/*.py stage_clock.py "
        "stop.py system_interface.py system_results.py viewer/*.py yaml_text.py",
    ),
)
"""Reading, writing, drawing, commands."""
