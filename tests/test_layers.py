"""The rules that keep the code readable, checked on the source: layers, rooms, imports, sizes."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from source_tree import (
    LAYERS,
    PACKAGE,
    PATHS,
    SOURCES,
    imported_modules,
    imported_names,
    location,
    nodes,
    parse,
    users_of_modules,
)

# The house. A module imports only from rooms to the left of its own. A word is a room (a folder,
# or a module that stands alone); [...] are the other modules of the folder, which make one room.
ROOMS = {
    "the layers": "graph  semantics  mapping  slam",
    "graph": """arrays  errors  files  [...]  inertial  factors  sensors  marginals
                smoother  batch  pose_graph  g2o  calibration""",
    "semantics": """[...]  instances  network  weights  segmenters  beliefs  objects  tracks
                    training""",
    "semantics/network": "config  backbone  [...]  yolox",
    "mapping": "[...]  inverse_depth  surface  products",
    "slam": """events  evaluation  config  sequences  features  world  rendering  datasets
               tracking  loops  moving  runtime  sensing  back_end  labelling  system_config
               system_interface  run_folder  system_results  sensor_input  system_state  system
               dense  calibration  refinement  viewer  live  parallel  offline  merging  reporting
               comparison  api  doctor  commands  cli  job_process  __init__  __main__""",
    "slam/sequences": "[...]  bags  formats  sequence  info  right_images  __init__",
    "slam/run_folder": "[...]  scene  export",
    "slam/rendering": "engine  things  rooms  [...]",
    "slam/dense": "[...]  growing",
    "slam/live": """[...]  ros2  sources  processes  network  system  start  health  display
                    recorder  live_map  live_slam  play""",
    "slam/live/sources": "[...]  cameras  opening",
    "slam/tracking": "pose  [...]",
    "slam/comparison": "experiment  jobs  statistics  report  [...]",
}
MAX_MODULES, MAX_LINES, MAX_FUNCTION_LINES, MAX_PARAMETERS = 12, 300, 40, 6
MIN_LINES = 60  # below, a module that only one other imports lives with it ...
SEAMS: dict[str, str] = {  # ... unless it is one of these
    "mapping/inverse_depth/search_range.py": "Step 1 of Algorithm 1",
    "slam/__main__.py": "python -m bmask_slam",
    "slam/commands/": "a module for one command or a few",
    "slam/job_process.py": "started by its name in a process of its own",
    "slam/rendering/rooms/": "loaded by the room's name",
}
NUMPY_ONLY = (
    *("graph.geometry", "graph.camera", "graph.errors", "graph.trajectory", "graph.metrics"),
    *("graph.factors.graph_update", "graph.files.ply"),
)
DEVELOPMENT_TOOLS = ("pytest", "hypothesis", "evo", "tests", "benchmarks")


def offenders(package: str) -> set[str]:
    """Modules that import a package, by path from the root."""
    return {
        location(path)
        for path in SOURCES
        if package in {name.partition(".")[0] for name, _ in imported_names(path)}
    }


def _within(folder: str, paths: set[str]) -> set[str]:
    return {path for path in paths if path.startswith(f"{folder}/")}


def _functions(path: Path) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for node in nodes(path):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield f"{location(path)} {node.name}", node


def _check(rule: str, found: dict[str, object]) -> None:
    lines = [f"{what}: {why}" for what, why in sorted(found.items())]
    assert not lines, "\n".join([f"offends the rule on {rule}:", *lines])


# --- layers and rooms ----------------------------------------------------------------------------


def test_the_source_tree_is_found() -> None:
    assert {location(path).partition("/")[0] for path in SOURCES} == set(LAYERS)
    assert "graph/smoother/smoother.py" in offenders("numpy")
    assert f"{PACKAGE}.graph.geometry" in imported_modules(f"{PACKAGE}.graph.metrics")


@pytest.mark.parametrize("folder", ROOMS)
def test_every_room_is_in_the_order(folder: str) -> None:
    named = ROOMS[folder].replace("[...]", "").split()
    here = LAYERS if folder == "the layers" else _entries(folder)
    if "[...]" in ROOMS[folder]:  # where a module need not be named
        here = [name for name in here if name in named or name.endswith("/")]
    assert sorted(named) == sorted(name.strip("/") for name in here)


def test_every_folder_with_folders_has_an_order() -> None:
    parents = {path.parent.parent for path in SOURCES if path.name == "__init__.py"}
    assert {location(p) for p in parents} - {"."} == set(ROOMS) - {"the layers"}


def _entries(folder: str) -> list[str]:
    """Modules of a folder by name, and its folders with a slash behind."""
    paths = [location(path) for path in SOURCES]
    inside = [path[len(folder) + 1 :] for path in paths if path.startswith(f"{folder}/")]
    names = {
        f"{name.partition('/')[0]}/" if "/" in name else name.removesuffix(".py") for name in inside
    }
    return sorted(names)


def _place(folder: str, module: str) -> int | None:
    """The position of a module's room in the order of a folder; None for another folder."""
    path = location(PATHS[module])
    order = ROOMS[folder].split()
    if folder != "the layers":
        if not path.startswith(f"{folder}/"):
            return None
        path = path[len(folder) + 1 :]
    name = path.partition("/")[0].removesuffix(".py")
    name = name if name in order else "[...]"
    return order.index(name) if name in order else len(order)


@pytest.mark.parametrize("folder", ROOMS)
def test_a_room_imports_only_from_its_left(folder: str) -> None:
    found: dict[str, object] = {}
    for module in PATHS:
        for target in imported_modules(module):
            here, there = _place(folder, module), _place(folder, target)
            if here is not None and there is not None and there > here:
                found[f"{module} -> {target}"] = "to the right"
    _check("rooms", found)


def test_there_are_no_import_cycles() -> None:
    graph = {module: set(imported_modules(module)) for module in PATHS}
    circle = []
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        circle = error.args[1]
    assert circle == []


def test_the_package_is_imported_by_its_full_name() -> None:
    found: dict[str, object] = {}
    for path in SOURCES:
        for module, name in imported_names(path):
            if module.startswith(".") or module.partition(".")[0] in LAYERS:
                found[f"{location(path)} {module}"] = f"write {PACKAGE}. ... in full"
            elif module == PACKAGE and name not in (*LAYERS, "__version__"):
                found[f"{location(path)} {name}"] = "import it from the module that defines it"
    _check("full names", found)


# --- libraries -----------------------------------------------------------------------------------


def test_gtsam_stays_in_graph() -> None:
    assert offenders("gtsam") - _within("graph", offenders("gtsam")) == set()


def test_graph_imports_no_images_or_networks() -> None:
    for package in ("cv2", "torch", "open3d", "matplotlib"):
        assert _within("graph", offenders(package)) == set()


def test_torch_stays_in_semantics_and_mapping() -> None:
    assert _within("slam", offenders("torch")) == set()


def test_open3d_is_imported_only_by_its_loader() -> None:
    assert {Path(path).name for path in offenders("open3d")} <= {"open3d_loader.py"}


def test_no_module_of_ours_needs_a_development_tool() -> None:
    for package in DEVELOPMENT_TOOLS:
        assert offenders(package) == set()


def test_numpy_only_modules_import_without_anything_else() -> None:
    modules = ", ".join(f"{PACKAGE}.{name}" for name in NUMPY_ONLY)
    code = (
        f"import sys, {modules}\n"
        "heavy = {'gtsam', 'scipy', 'cv2', 'torch', 'open3d', 'matplotlib', 'yaml'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# --- sizes and docstrings ------------------------------------------------------------------------


def test_every_package_and_module_has_a_docstring() -> None:
    docstrings = {location(path): ast.get_docstring(parse(path)) for path in SOURCES}
    found = {path: text for path, text in docstrings.items() if text in (None, "", "TODO.")}
    _check("docstrings", dict(found))


def test_folders_are_small() -> None:
    modules = Counter(location(p.parent) for p in SOURCES if p.name != "__init__.py")
    _check("folders", {path: n for path, n in modules.items() if n > MAX_MODULES})


def test_modules_are_short() -> None:
    lengths = {location(path): _lines(path) for path in SOURCES}
    _check("modules", {path: n for path, n in lengths.items() if n > MAX_LINES})


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def test_functions_are_short() -> None:
    found: dict[str, object] = {}
    for path in SOURCES:
        for name, node in _functions(path):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MAX_FUNCTION_LINES:
                found[name] = lines
    _check("functions", found)


def test_functions_have_few_parameters() -> None:
    found: dict[str, object] = {}
    for path in SOURCES:
        for name, node in _functions(path):
            parameters = [a.arg for a in _parameters(node.args) if a.arg not in ("self", "cls")]
            if len(parameters) > MAX_PARAMETERS:
                found[name] = parameters
    _check("parameters", found)


def _parameters(arguments: ast.arguments) -> list[ast.arg]:
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]


def test_a_small_module_is_in_its_only_users_folder() -> None:
    found: dict[str, object] = {}
    for module, users in users_of_modules().items():
        path = PATHS[module]
        small = path.name != "__init__.py" and _lines(path) < MIN_LINES
        if small and len(users) < 2 and not location(path).startswith(tuple(SEAMS)):
            found[location(path)] = f"imported only by {', '.join(users) or 'nobody'}"
    _check("small modules", found)


def test_seams_are_small_modules_with_one_user() -> None:
    users = users_of_modules()
    single = [p for module, p in PATHS.items() if len(users[module]) < 2 and _lines(p) < MIN_LINES]
    unused = [seam for seam in SEAMS if not any(location(p).startswith(seam) for p in single)]
    assert unused == []


def test_only_the_command_line_prints() -> None:
    found = set()
    for path in SOURCES:
        for node in nodes(path):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
                found.add(location(path))
    assert {path for path in found if not path.startswith("slam/commands/")} <= {"slam/cli.py"}
