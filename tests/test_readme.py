"""The documents are true: their commands and code run, and their tables match the code."""

import argparse
import configparser
import dataclasses
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from test_structure import DOORS, FLOOR

import evaluate
import train_high
import train_low
from tdgc import bench, calibration, diagnose, export, mujoco
from tdgc.ablate import __main__ as ablate
from tdgc.benchmark import planted
from tdgc.benchmark.evaluation import CONDITIONS
from tdgc.config import (
    HighLevelConfig,
    HighRewardConfig,
    LowRewardConfig,
    RandomisationConfig,
    RobotConfig,
)
from tdgc.sim.commands import CommandDecoder
from tdgc.sim.families import ALL_FAMILIES, PARAMETER_RANGES
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.sim.locomotion import actor_layout
from tdgc.tasks.high_observation import high_layout
from tdgc.tasks.high_rewards import HIGH_TERMS
from tdgc.tasks.low_rewards import LOW_TERMS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FOLDER = {path.name: path.parent for path in DOCUMENTS}
TEXT = {path.name: path.read_text(encoding="utf-8") for path in DOCUMENTS}
assert len(TEXT) == len(DOCUMENTS), "two documents have the same name"
MAINS = {
    "train_low.py": train_low.main,
    "train_high.py": train_high.main,
    "evaluate.py": evaluate.main,
    "tdgc.bench": bench.main,
    "tdgc.calibration": calibration.main,
    "tdgc.export": export.main,
    "tdgc.diagnose": diagnose.main,
    "tdgc.benchmark.planted": planted.main,
    "tdgc.mujoco": mujoco.main,
    "tdgc.ablate": ablate.main,
}


@dataclass(frozen=True)
class Run:
    """Flags added to a command to make it short, and the files it leaves in the workspace."""

    added: str
    leaves: tuple[str, ...]


LOW = "--steps 128 --n-envs 4 --workers 1 --set log_steps=128 --set calibration.robots=0"
HIGH = (
    "--steps 16 --n-envs 4 --workers 1 --set log_steps=8 "
    "--set ppo.n_steps=2 --set ppo.minibatches=1 --set imitation.minibatches=1 "
    "--set imitation.teacher.walk_speed=0.6"
)
ONE = "--episodes 1 --workers 1"
FALL = f"--policies gp --families gap --levels 10 {ONE}"  # into the first trench, within seconds
CLUMSY = "--low runs/low/policy"  # hardly trained: its episodes end within seconds
#: Commands that are run, in order: some need what those before them leave.
RUNS: dict[str, Run] = {
    "python train_low.py": Run(
        LOW,
        (
            "runs/low/config.json",
            "runs/low/policy.json",
            "runs/low/checkpoints/step-000000000128",
            "runs/low/tensorboard",
            "runs/low/training.png",
        ),
    ),
    "python train_low.py --resume --time-limit 3600": Run(
        "--steps 256", ("runs/low/policy.safetensors", "runs/low/checkpoints/step-000000000256")
    ),
    "tensorboard --logdir runs": Run("--inspect --logdir runs/low", ()),
    "python train_high.py --low runs/low/policy": Run(
        HIGH, ("runs/high/policy.safetensors", "runs/high/training.png")
    ),
    "python evaluate.py --low runs/low/policy --high runs/high/policy --levels 6-10": Run(
        f"--levels 6 --families tilt {ONE} --out runs/pair",
        tuple(
            f"runs/pair/{name}"
            for name in (
                "episodes.csv",
                "summary.json",
                "success.png",
                "gaits.png",
                "headings.png",
                "trajectories.png",
                "trajectories.npz",
            )
        ),
    ),
    "python evaluate.py --low runs/low/policy --tracking": Run(
        f"{ONE} --out runs/tracking", ("runs/tracking/tracking.json",)
    ),
    "python -m tdgc.export --low runs/low/policy --high runs/high/policy --out runs/export": (
        Run(
            "--low tdgc/pretrained/low --high tdgc/pretrained/high --format torchscript",
            ("runs/export/low.pt", "runs/export/high_interface.json"),
        )
    ),
    "python train_high.py --low runs/low/policy --init runs/high/policy "
    """--set 'env.families=["rough","stair","hills.npy"]' --out runs/hills""": Run(
        HIGH, ("runs/hills/policy.safetensors",)
    ),
    ".venv/bin/python evaluate.py --families stair,gap --levels 6 --episodes 1 "
    "--policies tdgc --video": Run(
        f"{FALL} {CLUMSY}",
        (
            "runs/evaluation/report.html",
            "runs/evaluation/films/film_gp_nominal_gap_10_000.mp4",
            "runs/evaluation/films/sheet_gp_nominal_gap_10_000.png",
            "runs/evaluation/films/strip_gap_10.png",
        ),
    ),
    "python evaluate.py --video --families stair,gap --levels 8": Run(  # filmed by the last one
        f"{FALL} {CLUMSY} --video 0", ("runs/evaluation/report.html",)
    ),
    "python evaluate.py --trace failed --out runs/traced": Run(
        f"{FALL} {CLUMSY}",
        ("runs/traced/diagnosis.csv", "runs/traced/traces/gp_nominal_gap_10_000.parquet"),
    ),
    "python evaluate.py --policies teacher --families stair,gap --episodes 20": Run(
        f"--families gap --levels 6 {ONE}", ("runs/evaluation/summary.json",)
    ),
    "python evaluate.py --policies tdgc --set decoder.vx.high=0.6 --set safety.max_tilt=0.5": (
        Run(
            f"--levels 0 --families rough {ONE} {CLUMSY} --high runs/high/policy",
            ("runs/evaluation/tuning.json",),
        )
    ),
    "python evaluate.py --families hills.npy": Run(
        f"--levels 5 --policies gp {ONE} {CLUMSY}", ("runs/evaluation/trajectories.png",)
    ),
    """python train_high.py --low tdgc/pretrained/low --set 'env.families=["yard.npy"]' """
    "--steps 600000 --set imitation.steps=160000 --out runs/yard": Run(
        HIGH, ("runs/yard/policy.safetensors",)
    ),
    "python evaluate.py --high runs/yard/policy --families yard.npy --policies tdgc,gp,teacher "
    "--episodes 20": Run(f"--levels 5 {ONE} {CLUMSY}", ("runs/evaluation/summary.json",)),
    "python evaluate.py --families ripples.npy,cobbles.npy,logs.npy,terraces.npy,dome.npy,"
    "bridge.npy,walls.npy,crates.npy": Run(
        f"--levels 5 --policies gp {ONE} {CLUMSY}", ("runs/evaluation/summary.json",)
    ),
    "python train_low.py --set env.robot.urdf=a1/a1.urdf --out runs/a1_low": Run(
        LOW, ("runs/a1_low/policy.safetensors",)
    ),
    "python train_high.py --low runs/a1_low/policy --out runs/a1_high": Run(
        HIGH, ("runs/a1_high/policy.safetensors",)
    ),
    "python evaluate.py --low pairs/a1/low --high pairs/a1/high --levels 6-10": Run(
        f"--families rough --levels 0 --policies tdgc {ONE}", ("runs/evaluation/summary.json",)
    ),
    "python -m tdgc.bench --out runs/bench": Run(
        "--robots 2 --workers 1 --seconds 0.1", ("runs/bench/bench.json",)
    ),
}
#: Commands that take long, or need a display or a cluster: only their flags are parsed.
READ = (
    "python evaluate.py --gui",
    "python evaluate.py --gui watch --families stair --levels 6",
    "python train_high.py --preset paper --out runs/paper",
    "python -m tdgc.calibration --low runs/low/uncalibrated --out runs/calibrated",
    "OMP_NUM_THREADS=1 python train_low.py --workers 1",
    "python -m tdgc.ablate --out runs/ablation",
    "python -m tdgc.diagnose run.npz --export runs/export --outcome fell",
    "python -m tdgc.benchmark.planted",
    "python -m tdgc.export --out runs/export",
    "python -m tdgc.mujoco --export runs/export --levels 6-10 --families all --episodes 20",
    "python -m tdgc.mujoco --export runs/export --levels 6,8,10 --episodes 50",
    "python evaluate.py --policies tdgc --levels 6,8,10 --episodes 50",
    "python train_high.py --no-teacher --low runs/low/policy --out runs/alone",
    "python -m tdgc.bench --load",
    "python -m tdgc.bench --update",
    "python -m tdgc.bench --cluster auto",
    "python train_high.py --low runs/low/policy --cluster auto --workers auto",
    "python evaluate.py --cluster auto",
)
#: Ray's own commands: only their flags are parsed.
RAY = (
    "RAY_worker_niceness=0 ray start --head --port=6379",
    "RAY_worker_niceness=0 ray start --address=HOST:6379",
)
#: Set-up and checks, which .ci/run runs as written, or with all extras and all tests.
BY_CI = (
    "python3 -m venv .venv",
    ".venv/bin/pip install -c constraints.txt -e '.[video,trace,export]'",
    "pip install -c constraints.txt -e '.[export,mujoco]'",
    ".venv/bin/pip install -c constraints.txt -e '.[dev]'",
    ".venv/bin/python -m pytest -n 2",
    ".venv/bin/python -m pytest tests/test_low_rewards.py",
    ".venv/bin/python -m ruff check",
    ".venv/bin/python -m ruff format --check",
    ".venv/bin/python -m mypy tdgc",
)
PROGRAMS = {
    ".venv/bin/python": [sys.executable],
    "tensorboard": [sys.executable, "-m", "tensorboard.main"],
}
ENVIRONMENT = r"^[A-Za-z_]+=\S+ "  # a variable set for a command


def blocks(text: str, language: str) -> list[str]:
    """A document's fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def commands() -> Iterator[str]:
    """The shell commands of all documents, without comments and split at ``&&``."""
    for text in TEXT.values():
        lines = "".join(blocks(text, "bash")).replace("\\\n", " ").splitlines()
        bare = [re.sub(r"(^|\s)#.*", "", line) for line in lines]
        yield from (part.strip() for line in bare if line.strip() for part in line.split("&&"))


def tables(name: str, heading: str | None = None) -> list[list[list[str]]]:
    """Tables of a document, or of one of its sections, as rows of cells without the header."""
    text = TEXT[name]
    if heading is not None:
        text = re.split("^## ", text.split(f"\n## {heading}\n")[1], flags=re.MULTILINE)[0]
    found = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)
    return [
        [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in table.splitlines()][
            2:
        ]
        for table in found
    ]


def column(table: list[list[str]], index: int = 0) -> list[str]:
    return [row[index] for row in table]


# ---------------------------------------------------------------------------- commands


def test_every_command_is_run_or_read() -> None:
    assert set(commands()) == {*RUNS, *READ, *RAY, *BY_CI}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which commands run as in the repository and write their files."""
    folder = tmp_path_factory.mktemp("workspace")
    for name in ("train_low.py", "train_high.py", "evaluate.py", "tdgc", "urdf", "pairs"):
        (folder / name).symlink_to(ROOT / name)
    return folder


@pytest.mark.usefixtures("in_process", "inline_workers", "quick_landing")
def test_commands_run(
    workspace: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(workspace)
    for length in ("_TRACKING_SECONDS", "_FALL_SECONDS"):
        monkeypatch.setattr(f"tdgc.benchmark.tracking.{length}", 2.0)
    for name, text in TEXT.items():
        for code in blocks(text, "python"):
            exec(compile(code, name, "exec"), {})  # some write a robot or a terrain
    for command, short in RUNS.items():
        program, *arguments = shlex.split(f"{command} {short.added}")
        if program == "python":  # not in a process of its own, which takes seconds to start
            script, *flags = [word for word in arguments if word != "-m"]
            status = MAINS[script](flags)
        else:
            words = [*PROGRAMS[program], *arguments]
            status = subprocess.run(words, stdin=subprocess.DEVNULL, timeout=600).returncode
        output = "".join(capfd.readouterr())[-4000:]
        assert status == 0, f"{command}\n{output}"
        left = [name for name in short.leaves if not (workspace / name).exists()]
        assert not left, f"{command} left no {', '.join(left)}"


def inline_commands() -> list[str]:
    """Commands with flags in the documents' sentences and tables; ``...`` stands for anything."""
    found = set()
    for text in TEXT.values():
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        for words in re.findall(r"`((?:python |evaluate\.py|train_\w+\.py)[^`]* --[^`]*)`", prose):
            if "..." not in words:
                found.add(words if words.startswith("python ") else f"python {words}")
    return sorted(found)


def test_documents_have_inline_commands() -> None:
    assert "python train_high.py --preset paper" in inline_commands()
    assert "python evaluate.py --conditions latency-30ms" in inline_commands()


@pytest.mark.parametrize("command", [*READ, *inline_commands()])
def test_flags_are_read(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class ReadError(Exception):
        """All flags were parsed."""

    parse = argparse.ArgumentParser.parse_args

    def stop(*args: object) -> None:
        parse(*args)  # type: ignore[call-overload]
        raise ReadError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    _, *arguments = shlex.split(re.sub(ENVIRONMENT, "", command))
    script, *flags = [word for word in arguments if word != "-m"]
    with pytest.raises(ReadError):
        MAINS[script](flags)


@pytest.mark.parametrize("command", RAY)
def test_rays_flags_are_read(command: str) -> None:
    from ray.scripts.scripts import cli

    _, *arguments = shlex.split(re.sub(ENVIRONMENT, "", command))
    group = cli.make_context("ray", list(arguments))
    name, start, rest = cli.resolve_command(group, arguments)
    assert name == "start" and start.make_context(name, rest, parent=group).params


def test_ci_finds_the_test_command() -> None:
    lines = TEXT["README.md"].splitlines()
    assert len([line for line in lines if re.search("^python3 .* -m pytest -n 2$", line)]) == 1
    workflow = ROOT / ".github" / "workflows" / "ci.yml"
    assert "- run: .ci/run\n" in workflow.read_text(encoding="utf-8")


# ---------------------------------------------------------------------------- tables


def test_commands_are_the_decoders() -> None:
    decoder = CommandDecoder()
    bounds = zip(decoder.low, decoder.high, strict=True)
    expected = [
        [name, unit, f"{low:g} {'to' if i < 12 else 'or'} {high:g}"]
        for i, (name, unit, (low, high)) in enumerate(
            zip(decoder.names, decoder.units, bounds, strict=True)
        )
    ]
    assert [row[:3] for row in tables("commands.md")[0]] == expected


def test_gaits_are_the_codes() -> None:
    decoder = CommandDecoder()
    for row, name in zip(tables("commands.md")[1], GAITS, strict=True):
        ends = [float(x) for x in row[2].split(" to ")]
        embedding = [float(x) for x in row[3].split(", ")]
        assert row[:2] == [name, str(GAITS.index(name))]
        assert embedding == GAIT_TABLE[GAITS.index(name)].tolist()
        inside = [0.0] * 12 + [sum(ends) / 2.0]
        assert decoder.gait(inside) == GAITS.index(name)
        assert decoder.gait([0.0] * 12 + [ends[0]]) == GAITS.index(name)


def test_observations_are_those_of_the_layouts() -> None:
    layouts = actor_layout(RobotConfig(), gyro=True), high_layout(HighLevelConfig())
    for table, layout in zip(tables("commands.md", "Observations"), layouts, strict=True):
        found = [(row[0], int(row[1])) for row in table]
        assert sorted(found) == sorted((term.name, term.size) for term in layout)


@pytest.mark.parametrize(
    ("heading", "terms", "weights"),
    [
        ("Rewards of the low policy", LOW_TERMS, LowRewardConfig()),
        ("Rewards of the high policy", HIGH_TERMS, HighRewardConfig()),
    ],
)
def test_rewards_are_the_defaults(
    heading: str, terms: Mapping[str, object], weights: LowRewardConfig | HighRewardConfig
) -> None:
    found = [row[:2] for row in tables("mdp.md", heading)[0]]
    assert found == [[name, f"{getattr(weights, name):g}"] for name in terms]


def test_what_is_randomised_is_the_default() -> None:
    expected = []
    for setting in dataclasses.fields(RandomisationConfig):
        value = getattr(RandomisationConfig(), setting.name)
        ends = value if isinstance(value, tuple) else (value,)
        expected.append([setting.name, " to ".join(f"{end:g}" for end in ends)])
    found = [row[:2] for row in tables("mdp.md", "What is randomised")[0]]
    assert sorted([["scale", "1"], *found]) == sorted(expected)


def test_families_are_the_terrains() -> None:
    table = tables("benchmark.md")[0]
    assert tuple(column(table)) == ALL_FAMILIES
    for family, _, first, last in table:
        if family not in ("mixed", "ditches"):  # which combine others
            assert (float(first.split()[0]), float(last.split()[0])) == PARAMETER_RANGES[family]


def test_conditions_are_the_benchmarks() -> None:
    assert column(tables("benchmark.md", "Protocol")[0]) == list(CONDITIONS)


@pytest.mark.parametrize(
    ("name", "heading", "place", "main"),
    [
        ("train.md", "The low policy", 0, calibration.main),
        ("train.md", "Flags", 0, train_high.main),
        ("evaluate.md", None, 0, evaluate.main),
        ("deploy.md", "Export", 0, export.main),
        ("scaling.md", "Measure it", 0, bench.main),
        ("experiments.md", "What matters", 1, ablate.main),
    ],
)
def test_flags_are_the_scripts(
    name: str,
    heading: str | None,
    place: int,
    main: Callable[[list[str]], int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert column(tables(name, heading)[place]) == flags(main, capsys)


def test_both_trainers_take_the_same_flags(capsys: pytest.CaptureFixture[str]) -> None:
    both, low = flags(train_high.main, capsys), flags(train_low.main, capsys)
    assert both == [*low, "--low", "--preset", "--no-teacher"]


def flags(main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The flags in a script's help, in order."""
    with pytest.raises(SystemExit):
        main(["--help"])
    return re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, flags=re.MULTILINE)


# ---------------------------------------------------------------------------- what they name


def test_rooms_are_in_order() -> None:
    named = [
        path.removeprefix("tdgc/").rstrip("/").removesuffix(".py")
        for row in tables("CONTRIBUTING.md", "Where things are")[0]
        for path in re.findall(r"[\w./]+", row[0])
    ]
    rooms = [name for name in named if name in FLOOR]
    assert {*rooms, "tdgc"} == FLOOR.keys()
    assert [FLOOR[name] for name in rooms] == sorted(FLOOR[name] for name in rooms)
    assert set(named) - set(rooms) == {"pretrained", "pairs", "urdf"}
    assert not [door for door in DOORS if f"`tdgc.{door}`" not in TEXT["CONTRIBUTING.md"]]


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", TEXT)
def test_what_is_named_is_there(name: str) -> None:
    text, folder = TEXT[name], FOLDER[name]
    paths = re.findall(r"(?:tdgc|docs|tests|urdf|pairs|\.ci)/[\w/.-]*\w", text)
    made = ("tdgc/LowLevel-v0", "tdgc/Navigation-v0", "docs/robot.gif")
    places = [link.split("#") for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text)]
    links = [place[0] for place in places]
    missing = [p for p in paths if p not in made and not (ROOT / p).exists()]
    missing = [p for p in missing if not (ROOT / f"{p}.json").is_file()]  # a policy, no suffix
    missing += [p for p in links if p and p not in made and not (folder / p).exists()]
    headings = [(Path(p or name).name, *anchor) for p, *anchor in places if anchor]
    missing += [f"{page}#{a}" for page, a in headings if a not in anchors(TEXT[page])]
    assert not missing


@pytest.mark.parametrize("name", TEXT)
def test_rows_are_as_wide_as_their_table(name: str) -> None:
    prose = re.sub(r"^```.*?^```$", "", TEXT[name], flags=re.MULTILINE | re.DOTALL)
    for table in re.findall(r"(?:^\|.*\n)+", prose, flags=re.MULTILINE):
        header, *rows = [line.replace("\\|", "").count("|") for line in table.splitlines()]
        assert rows == [header] * len(rows), table


def test_extras_are_in_setup() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    lists = [found for text in TEXT.values() for found in re.findall(r"'\.\[([\w,]+)\]'", text)]
    named = {extra for found in lists for extra in found.split(",")}
    assert named == set(setup["options.extras_require"])
