"""Configuration: precedence, types, messages, and the round trip through YAML."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bmask_slam.config.configuration import differences, dump, find_config, from_text, resolve
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.system_config import SystemConfig


class Kernel(Enum):
    HUBER = "huber"
    OFF = "off"


@dataclass(frozen=True)
class Tracking:
    min_inliers: int = 20
    sigma_px: float = 1.5
    use_depth: bool = True
    kernel: Kernel = Kernel.HUBER

    def __post_init__(self) -> None:
        if self.min_inliers < 3:
            raise ValueError(f"min_inliers = {self.min_inliers}: must be at least 3")


@dataclass(frozen=True)
class Window:
    low_m: float = 1.0
    high_m: float = 2.0

    def __post_init__(self) -> None:
        if self.low_m >= self.high_m:
            raise ValueError(f"low_m = {self.low_m} must be below high_m = {self.high_m}")


@dataclass(frozen=True)
class Config:
    tracking: Tracking = field(default_factory=lambda: Tracking(min_inliers=30))
    window: Window | None = None
    name: str = "x"
    mode: Literal["all", "none", 3] = "all"
    limit_s: float | None = None
    scales: tuple[float, ...] = (1.0, 2.0)
    size: tuple[int, int] = (640, 480)
    labels: tuple[str, ...] = ()


def write(folder: Path, text: str) -> Path:
    path = folder / "c.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(file: Path | None, *overrides: str) -> str:
    with pytest.raises(InputError) as error:
        resolve(Config, file, overrides)
    return str(error.value)


def test_defaults_file_and_overrides_in_this_order(tmp_path: Path) -> None:
    file = write(tmp_path, "tracking: {sigma_px: 3, use_depth: false}\nname: f")
    config = resolve(Config, file, ["tracking.sigma_px=4", "tracking.sigma_px=5.5"])
    assert config.tracking == Tracking(30, 5.5, False)  # 30 is the parent's default, not 20
    assert config.name == "f"
    assert type(config.tracking.sigma_px) is float


def test_no_options_give_the_default() -> None:
    assert resolve(Config) == Config()


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert resolve(Config, write(tmp_path, "# nothing\n")) == Config()


@pytest.mark.parametrize(
    ("override", "path", "expected"),
    [
        ("tracking.sigma_px=1e-3", "sigma_px", 1e-3),  # a text in YAML 1.1
        ("tracking.sigma_px=2", "sigma_px", 2.0),
        ("tracking.sigma_px=.inf", "sigma_px", math.inf),
        ("tracking.min_inliers=010", "min_inliers", 10),  # eight in YAML 1.1
        ("tracking.kernel=off", "kernel", Kernel.OFF),  # false in YAML 1.1
        ("tracking.kernel=HUBER", "kernel", Kernel.HUBER),
        ("tracking.use_depth=false", "use_depth", False),
    ],
)
def test_values_of_the_tracking_group(override: str, path: str, expected: object) -> None:
    value = getattr(resolve(Config, None, [override]).tracking, path)
    assert value == expected
    assert type(value) is type(expected)


def test_optional_literal_and_tuple_values() -> None:
    overrides = ["limit_s=2", "mode=3", "scales=[1, 2.5, 3]", "size=[3, 4]", "labels=[on, b]"]
    config = resolve(Config, None, overrides)
    assert config.limit_s == 2.0
    assert type(config.limit_s) is float
    assert (config.mode, config.scales, config.size) == (3, (1.0, 2.5, 3.0), (3, 4))
    assert config.labels == ("on", "b")
    assert resolve(Config, None, [*overrides, "limit_s=null"]).limit_s is None


def test_an_optional_group_appears_when_it_is_given() -> None:
    assert resolve(Config, None, ["window.high_m=7"]).window == Window(1.0, 7.0)
    both = ["window.low_m=5", "window.high_m=7"]  # the first alone would be refused
    assert resolve(Config, None, both).window == Window(5.0, 7.0)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("tracking.min_inliers=2.5", "tracking.min_inliers = 2.5 is not a whole number"),
        ("tracking.min_inliers=2.0", "is not a whole number"),
        ("tracking.min_inliers=true", "is not a whole number"),
        ("tracking.sigma_px=fast", "tracking.sigma_px = fast is not a number"),
        ("tracking.sigma_px=true", "is not a number"),
        ("tracking.sigma_px=.nan", "is not a number"),
        ("tracking.sigma_px=", "tracking.sigma_px = null is not a number"),
        ("tracking.use_depth=1", "is not true or false"),
        ("tracking.use_depth=yes", "is not true or false"),
        ("tracking.kernel=cauchy", "is not one of: 'huber' or 'off'"),
        ("mode=4", "mode = 4 is not one of: 'all', 'none' or 3"),
        ("limit_s=never", "limit_s = never is not a number"),
        ("scales=1", "scales = 1 is not a list"),
        ("size=[1, 2, 3]", "size = [1, 2, 3]: Tuple should have at most 2 items"),
        ("size=[1]", "size[1] is missing"),
        ("scales=[1, fast]", "scales[1] = fast is not a number"),
        ("scales=[1, .nan]", "is not a number"),
        ("name=12", "is not a text"),
        ("tracking=3", "tracking is a group of keys"),
        ("name.first=3", "name = {first: 3} is not a text"),
        ("tracking.min_inlier=3", "did you mean tracking.min_inliers?"),
        ("min_inliers=3", "did you mean tracking.min_inliers?"),
        ("tracking.qqq=3", "there are: tracking.min_inliers, tracking.sigma_px"),
        ("tracking.min_inliers=2", "tracking: min_inliers = 2: must be at least 3"),
        ("window.low_m=9", "window: low_m = 9.0 must be below high_m = 2.0"),
        ("tracking.min_inliers", "write it as key.subkey=value"),
        ("name=[", "--set name=["),
        ("tracking.sigma_px=1" + "0" * 400, "is not a number"),
    ],
)
def test_refusals_name_the_path_the_value_and_the_cure(override: str, expected: str) -> None:
    message = refusal(None, override)
    assert message.startswith(f"--set {override}")
    assert expected in message


def test_a_refusal_in_a_file_names_the_file(tmp_path: Path) -> None:
    file = write(tmp_path, "tracking: {sigma_px: fast}")
    assert refusal(file) == f"{file}: tracking.sigma_px = fast is not a number"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: a\nname: b\n", 'line 2: found duplicate key "name"; remove one'),
        ("name: [a\n", "line 2"),
        ("- 1\n", "is a group of keys"),
        ("1: 2\n", "unknown key 1"),
        ("name: !!python/object:os.system x\n", "could not determine a constructor"),
    ],
)
def test_broken_files_name_the_file_and_line(tmp_path: Path, text: str, expected: str) -> None:
    file = write(tmp_path, text)
    message = refusal(file)
    assert message.startswith(str(file))
    assert expected in message


def test_a_missing_file_and_a_binary_file(tmp_path: Path) -> None:
    assert "no.yaml: no such file" in refusal(tmp_path / "no.yaml")
    binary = tmp_path / "b.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert "not a text file" in refusal(binary)


NUMBERS = st.floats(allow_nan=False)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
CONFIGS = st.builds(
    Config,
    tracking=st.builds(Tracking, st.integers(3), NUMBERS, st.booleans(), st.sampled_from(Kernel)),
    window=st.none() | st.builds(Window, NUMBERS.map(lambda x: -abs(x) - 1), st.just(0.0)),
    name=TEXTS | st.sampled_from(["null", "1e-3", "off", "010", "~", "", "1:30", "2020-01-01"]),
    mode=st.sampled_from(["all", "none", 3]),
    limit_s=st.none() | NUMBERS,
    scales=st.lists(NUMBERS, max_size=3).map(tuple),
    size=st.tuples(st.integers(), st.integers()),
    labels=st.lists(TEXTS, max_size=3).map(tuple),
)


@given(config=CONFIGS)
def test_a_dumped_configuration_resolves_to_an_equal_one(
    config: Config, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    file.write_text("# a comment\n" + dump(config), encoding="utf-8", newline="")
    assert resolve(Config, file) == config


def test_shipped_configurations_are_found_by_name() -> None:
    with pytest.raises(InputError, match=r"nothing\.yaml: no such file; there are: "):
        find_config("nothing")
    assert find_config("./nothing") == Path("nothing")
    assert find_config("a/b.yaml") == Path("a/b.yaml")
    for path in data_path("configs").glob("*.yaml"):
        assert find_config(path.stem) == path


def test_a_file_without_a_suffix_is_found(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine").write_text("final_adjustment: false\n")
    assert not resolve(SystemConfig, find_config("mine")).final_adjustment


def test_a_count_below_zero_is_refused() -> None:
    with pytest.raises(InputError, match=r"features\.max_keypoints = -5 is negative; give 0 or"):
        resolve(SystemConfig, None, ["features.max_keypoints=-5"])
    with pytest.raises(InputError, match="relinearize_skip = 0: must be at least 1"):
        resolve(SystemConfig, None, ["graph.relinearize_skip=0"])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("features.thresholds=[]", "thresholds must not be empty"),
        ("features.bucket_px=0", "bucket_px at least 1"),
        ("tracking.pose.kernel_iterations=0", "kernel_iterations and final_iterations must be"),
        ("tracking.image_motion.window_px=2", "window_px must be at least 3"),
        ("tracking.newcomers.gate=0", "gate, min_speed_m_s and max_sigma_m positive"),
        ("tracking.pose.max_noise_scale=0", "max_noise_scale must be at least 1"),
        ("tracking.match.max_scale_ratio=0", "max_scale_ratio must be more than 1"),
        ("features.pixel_sigma=0", "pixel_sigma and disparity_sigma_px must be more than 0"),
        ("features.disparity_sigma_px=-1", "pixel_sigma and disparity_sigma_px must be more"),
        ("loops.index.query_keypoints=0", "query_keypoints, lists and probes must be"),
        ("loops.index.lists=0", "query_keypoints, lists and probes must be"),
        ("loops.verification.radii_px=[]", "radii_px must not be empty"),
        ("loops.noise.prior_loops=0", "prior_loops and prior_closings must be positive"),
    ],
)
def test_what_would_end_at_the_first_frame_or_loop_is_refused(override: str, words: str) -> None:
    group = override.partition("=")[0].rpartition(".")[0]
    with pytest.raises(InputError, match=rf"^--set {re.escape(override)}: {group}: .*{words}"):
        resolve(SystemConfig, None, (override,))


def test_an_older_file_is_read_with_the_present_names_of_its_settings(tmp_path: Path) -> None:
    """A file of an older version with the former names and all defaults."""
    older = Path(__file__).with_name("before_renaming.yaml")
    differing = differences(resolve(SystemConfig, older), SystemConfig())
    set_by_conftest, of_the_camera_now = "semantics.segmenter.name", "features.disparity_sigma_px"
    other_defaults = {
        "semantics.segmenter.min_score",
        "semantics.object_score",
        "semantics.objects.association.max_cost",
        "features.thresholds",
        "factor_selection.full_keyframes",
        "graph.relinearize_threshold",
        "keyframes.max_shared",
        "keyframes.late_shared",
    }
    assert set(differing) <= {set_by_conftest, of_the_camera_now, *other_defaults}
    read = from_text(SystemConfig, older.read_text(encoding="utf-8"), "here")
    assert read == resolve(SystemConfig, older)
    graph = replace(SystemConfig().graph, relinearize_threshold=0.003)
    assert resolve(SmootherConfig, older, section="graph") == graph
    text = "dynamics: {suspects: {frames: 7}}\nfactor_selection: {retire_batch: 9}\n"
    config = resolve(SystemConfig, write(tmp_path, text))
    assert config.moving_objects.static_verification.frames == 7
    assert config.factor_selection.marginalise_batch == 9
    grouped = resolve(SystemConfig, write(tmp_path, "mapping: {local_keyframes: 4}\n")).mapping
    assert grouped.local_map.keyframes == 4


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("dynamics.labels=false", "unknown key dynamics; it is called moving_objects now"),
        ("feed.retire_batch=3", "unknown key feed; it is called factor_selection now"),
        ("graph.max_recoveries=3", "it is called graph.max_repairs now"),
    ],
)
def test_an_older_name_on_the_command_line_is_refused_with_the_present_one(
    override: str, expected: str
) -> None:
    with pytest.raises(InputError) as error:
        resolve(SystemConfig, None, [override])
    assert expected in str(error.value)


def test_an_older_and_the_present_name_in_one_file_are_refused(tmp_path: Path) -> None:
    file = write(tmp_path, "feed: {}\nfactor_selection: {}\n")
    with pytest.raises(InputError, match="unknown key feed; it is called factor_selection now"):
        resolve(SystemConfig, file)


@pytest.mark.parametrize("text", ["{old}, {new}", "{new}, {old}"])
def test_an_older_setting_beside_others_of_its_present_group(tmp_path: Path, text: str) -> None:
    """The group may be given too, before or after it."""

    def loops(new: str) -> str:
        return "loops: {" + text.format(old="drift_rad_per_m: 0.5", new=f"noise: {new}") + "}\n"

    noise = resolve(SystemConfig, write(tmp_path, loops("{model_share: 0.25}"))).loops.noise
    assert (noise.drift_rad_per_m, noise.model_share) == (0.5, 0.25)
    with pytest.raises(InputError, match=r"drift_rad_per_m; it is called loops\.noise\.drift_rad"):
        resolve(SystemConfig, write(tmp_path, loops("{drift_rad_per_m: 0.25}")))
    with pytest.raises(InputError, match=r"loops\.noise is a group|drift_rad_per_m; it is called"):
        resolve(SystemConfig, write(tmp_path, loops("5")))


def test_a_setting_that_is_no_more_is_named_with_what_serves_now(tmp_path: Path) -> None:
    file = tmp_path / "old.yaml"
    file.write_text("features: {octaves: 2}")
    with pytest.raises(InputError, match=r"octaves.*no more, see features\.layer_shares"):
        resolve(SystemConfig, file)
