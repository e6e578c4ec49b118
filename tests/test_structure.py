"""The house rules: where PyBullet is, which way imports point, what no file may mention."""

import ast
import os
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import gymnasium
import pytest

import tdgc

ROOT = Path(__file__).resolve().parents[1]

#: A module may import modules of a lower rank only, so there is no cycle. A new module needs a
#: rank here; a rank may wait for its module.
RANKS = {
    "tdgc": 0,
    "errors": 0,
    "cores": 0,
    "config": 1,
    "state": 1,
    "terrain": 1,
    "gaits": 1,
    "curriculum": 1,
    "commands": 2,
    "geometry": 2,
    "tiles": 2,
    "robot": 3,
    "worker": 2,
    "cluster": 3,
    "world": 4,
    "group": 4,
    "rewards": 4,
    "locomotion": 5,
    "policies": 5,
    "leaps": 6,
    "low_env": 7,
    "recurrent": 7,
    "teacher": 7,
    "high_env": 8,
    "imitation": 8,
    "vec": 8,
    "training": 9,
    "drivers": 9,
    "evaluation": 10,
    "recording": 11,
    "trace": 11,
    "tuning": 11,
    "bench": 11,
    "calibration": 11,
    "export": 11,
    "plots": 12,
    "diagnosis": 13,
    "film": 13,
    "report": 14,
    "gui": 14,
    "train_low": 15,
    "train_high": 15,
    "evaluate": 15,
}
SCRIPTS = ("train_low", "train_high", "evaluate")


def sources() -> dict[str, Path]:
    """Module name, without the package, -> file: the package's modules and the scripts."""
    package = ROOT / "tdgc"
    modules = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        modules[".".join(p for p in parts if p != "__init__") or "tdgc"] = path
    return modules | {path.stem: path for path in sorted(ROOT.glob("*.py"))}


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


def own(name: str, modules: dict[str, Path]) -> str | None:
    """The module of this repository that a dotted name means, or None."""
    first, _, rest = name.partition(".")
    if first in SCRIPTS:
        return first
    if first != "tdgc":
        return None
    second = rest.partition(".")[0]
    return second if second in modules or second in RANKS else "tdgc"


MODULES = sources()


def test_every_module_has_a_rank() -> None:
    assert not MODULES.keys() - RANKS.keys()


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_one_way(module: str) -> None:
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    used = {name for name in (own(n, MODULES) for n in imports(tree)) if name is not None}
    wrong = sorted(name for name in used if RANKS[name] >= RANKS[module])
    assert not wrong, f"{module} imports {', '.join(wrong)}, which is not below it"


@pytest.mark.parametrize("module", MODULES)
def test_only_world_imports_pybullet(module: str) -> None:
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    bullet = [name for name in imports(tree) if name.startswith("pybullet")]
    assert bool(bullet) == (module == "world"), f"{module}: {bullet}"


@pytest.mark.parametrize("module", MODULES)
def test_only_cluster_imports_ray_and_not_before_it_is_asked_for(module: str) -> None:
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    asked = [name for name in imports(tree) if name.partition(".")[0] == "ray"]
    assert bool(asked) == (module == "cluster"), f"{module}: {asked}"
    at_once = ast.Module([n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)], [])
    assert not [name for name in imports(at_once) if name.partition(".")[0] == "ray"]


def test_rules_see_every_kind_of_import() -> None:
    tree = ast.parse(
        "import tdgc.world as w\n"
        "from tdgc import rewards, __version__\n"
        "def f():\n"
        "    from tdgc.vec import TaskVecEnv\n"
        "    importlib.import_module('pybullet')\n"
    )
    found = list(imports(tree))
    assert [own(name, MODULES) for name in found if name.startswith("tdgc")] == [
        "world", "rewards", "tdgc", "vec"
    ]  # fmt: skip
    assert "pybullet" in found


def files() -> Iterator[Path]:
    """Every file of the repository, without what tools and runs leave behind."""
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
    setup = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    required = re.findall(r"^    ([a-z0-9-]+)(?:>=[0-9.]+)?$", setup, flags=re.MULTILINE)
    assert {"torch", "pytest"} <= set(required) <= pinned


@pytest.mark.skipif(sys.platform != "linux", reason="the mode of a file")
def test_ci_can_be_run() -> None:
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
