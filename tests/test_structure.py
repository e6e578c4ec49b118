"""House rules: where PyBullet is imported, which way imports point, what no file may mention."""

import ast
import configparser
import functools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

import gymnasium
import pytest

import tdgc

ROOT = Path(__file__).resolve().parents[1]

#: From the ground up, each floor's rooms: folders, and modules outside any folder. A module imports
#: only from lower floors and from its own room, so rooms on the same floor are independent.
FLOORS = (
    ("tdgc", "errors", "state"),
    ("config", "files"),
    ("policies", "sim", "parallel"),
    ("tasks",),
    ("learn", "benchmark"),
    ("calibration", "deploy", "show", "bench"),
    ("diagnose", "export", "mujoco", "train_low", "train_high", "evaluate"),
    ("ablate",),
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
SCRIPTS = FLOORS[-2][-3:]
#: Modules that other people's scripts import from -> where their names are defined, the names.
DOORS = {
    "terrain": ("sim.terrain", {"make_tile"}),
    "commands": ("sim.commands", {"CommandDecoder"}),
    "gaits": ("sim.gaits", {"GAITS", "PhaseClock"}),
    "high_env": ("tasks.pairing", {"load_low"}),
    "drivers": ("benchmark.drivers", {"BaselineDriver", "HierarchyDriver", "load_high"}),
    "evaluation": ("benchmark.evaluation", {"Cell", "run_cell"}),
}


def sources() -> dict[str, Path]:
    """Files of the package's modules and of the scripts, by module name without the package."""
    package = ROOT / "tdgc"
    modules = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        modules[".".join(p for p in parts if p != "__init__") or "tdgc"] = path
    return modules | {path.stem: path for path in sorted(ROOT.glob("*.py"))}


@functools.cache
def tree(module: str) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def imports(tree: ast.AST) -> Iterator[str]:
    """Absolute dotted names that a source file imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            name = node.args[0]
            if called in ("import_module", "__import__") and isinstance(name, ast.Constant):
                yield str(name.value)


def own(name: str) -> str | None:
    """The module of this repository that a dotted name refers to, or None."""
    first, _, rest = name.partition(".")
    if first in SCRIPTS:
        return first
    if first != "tdgc":
        return None
    module = rest
    while module and module not in MODULES:
        module = module.rpartition(".")[0]
    # Without this check, an installed older version could hide that a module has moved.
    assert module or rest in ("", "__version__", "ENVIRONMENTS"), f"{name}: there is no such module"
    return module or "tdgc"


def used(module: str) -> set[str]:
    """The modules of this repository that ``module`` imports."""
    return {name for name in map(own, imports(tree(module))) if name is not None}


def importers(package: str) -> set[str]:
    """The modules that import from packages whose names begin with ``package``."""
    return {m for m in MODULES if any(name.startswith(package) for name in imports(tree(m)))}


def room(module: str) -> str:
    """The folder of a module, or the module itself if it is outside any folder."""
    return module.partition(".")[0]


MODULES = sources()
INSIDE = [module for module in MODULES if module not in DOORS]


def test_every_room_has_a_floor() -> None:
    assert set(map(room, INSIDE)) == FLOOR.keys()


def test_imports_point_one_way() -> None:
    wrong = [
        f"{module} imports {name}, which is not below it"
        for module in INSIDE
        for name in used(module) - DOORS.keys()
        if room(name) != room(module) and FLOOR[room(name)] >= FLOOR[room(module)]
    ]
    assert not wrong


def test_no_modules_import_each_other() -> None:
    graph = {module: used(module) for module in MODULES}
    assert len(list(TopologicalSorter(graph).static_order())) == len(MODULES)


def test_nothing_inside_goes_through_a_door() -> None:
    assert not [module for module in MODULES if used(module) & DOORS.keys()]


@pytest.mark.parametrize("door", DOORS)
def test_doors_lead_to_what_they_name(door: str) -> None:
    place, names = DOORS[door]
    opened, home = import_module(f"tdgc.{door}"), import_module(f"tdgc.{place}")
    assert set(opened.__all__) == names
    assert all(getattr(opened, name) is getattr(home, name) for name in names)
    assert [type(node) for node in tree(door).body] == [ast.ImportFrom, ast.Assign]


def test_importing_the_package_is_light() -> None:
    code = "import sys, tdgc; print(*(m for m in sys.modules if m.startswith('tdgc')))"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["tdgc"]


def test_each_simulator_and_ray_have_one_door() -> None:
    assert importers("pybullet") == {"sim.bullet_world"}
    assert importers("mujoco") == {"sim.mujoco_world"}
    assert importers("ray") == {"parallel.cluster"}


def test_ray_is_not_imported_before_it_is_asked_for() -> None:
    body = tree("parallel.cluster").body
    at_once = ast.Module([n for n in body if isinstance(n, ast.Import | ast.ImportFrom)], [])
    assert not [name for name in imports(at_once) if name.partition(".")[0] == "ray"]


def test_rules_see_every_kind_of_import() -> None:
    tree = ast.parse(
        "import tdgc.sim.world as w\n"
        "from tdgc import config, __version__\n"
        "from tdgc.tasks import high_rewards\n"
        "def f():\n"
        "    from tdgc.parallel.vec import TaskVecEnv\n"
        "    importlib.import_module('pybullet')\n"
    )
    found = list(imports(tree))
    assert [own(name) for name in found if name.startswith("tdgc")] == [
        "sim.world", "config", "tdgc", "tasks.high_rewards", "parallel.vec"
    ]  # fmt: skip
    assert "pybullet" in found


def files() -> Iterator[Path]:
    """Every file of the repository, except what tools and runs leave behind."""
    left_behind = {"runs", "build", "dist", "__pycache__"}
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [
            name
            for name in folders
            if name == ".ci"
            or not (name.startswith(".") or name in left_behind or name.endswith(".egg-info"))
        ]
        yield from (Path(folder, name) for name in names if name != ".git")


def test_no_file_mentions_a_path_of_one_machine() -> None:
    words = [f"/{folder}/".encode() for folder in ("work", "root", "home")]
    found = []
    for path in files():
        content = path.read_bytes()
        found += [f"{path.relative_to(ROOT)}: {w.decode()}" for w in words if w in content]
    assert not found


def test_changelog_begins_with_the_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (\S+)", text, flags=re.MULTILINE)
    assert versions[0] == tdgc.__version__


@pytest.mark.parametrize("name", tdgc.ENVIRONMENTS)
def test_environments_are_registered(name: str) -> None:
    module, _, attribute = tdgc.ENVIRONMENTS[name].partition(":")
    assert gymnasium.spec(name).entry_point == tdgc.ENVIRONMENTS[name]
    assert issubclass(getattr(import_module(module), attribute), gymnasium.Env)


def test_constraints_pin_every_dependency() -> None:
    """Each requirement of setup.cfg has a version, so that a fresh install is the tested one."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.partition("==")[0] for line in lines if "==" in line}
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    texts = [setup["options"]["install_requires"], *setup["options.extras_require"].values()]
    lines = [line for text in texts for line in text.splitlines() if line.strip()]
    required = {re.match(r"[\w.-]+", line)[0] for line in lines} - {"tdgc"}
    assert {"torch", "pytest"} <= required <= pinned


@pytest.mark.skipif(sys.platform != "linux", reason="the mode of a file")
def test_ci_can_be_run() -> None:
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
