"""README is true: its commands and code run, its tables are what the code has."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import evaluate
import train_low
from tdgc.benchmark.evaluation import CONDITIONS
from tdgc.sim.commands import CommandDecoder
from tdgc.sim.terrain import file_label

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")

BY_CI = None  # .ci/run runs the set-up and the tests as README has them
TRAIN = "--steps 128 --n-envs 4 --workers 1"
TRAIN_HIGH = "--steps 16 --n-envs 4 --workers 1 --set ppo.n_steps=2 --set ppo.minibatches=1"
#: Each command of README -> what is added to make it short, or BY_CI. ``{tmp}`` is a folder that
#: the commands share; they are in README's order.
COMMANDS: dict[str, str | None] = {
    "python3 -m venv .venv": BY_CI,
    ".venv/bin/pip install -c constraints.txt -e .": BY_CI,
    ".venv/bin/python evaluate.py --levels 6-10": (
        "--levels 6 --families tilt --episodes 1 --workers 1 --out {tmp}/first"
    ),
    ".venv/bin/pip install -c constraints.txt -e '.[dev]'": BY_CI,
    ".venv/bin/python -m pytest -n 2": BY_CI,
    "python train_low.py": f"{TRAIN} --out {{tmp}}/low",
    "python train_low.py --resume --time-limit 3600": "--steps 256 --out {tmp}/low",
    "tensorboard --logdir runs": "--inspect --logdir {tmp}/low",
    "python -m tdgc.calibration --low runs/low/policy --out runs/low/calibrated": (
        "--low {tmp}/low/policy --robots 64 --turns 1 --workers 1 --out {tmp}/low/calibrated"
    ),
    "python train_high.py --low runs/low/calibrated": (
        f"{TRAIN_HIGH} --low {{tmp}}/low/calibrated --out {{tmp}}/high"
    ),
    "python evaluate.py --low runs/low/calibrated --policies gp --levels 6-10": (
        "--low {tmp}/low/calibrated --policies gp --levels 6 --families tilt --episodes 1 "
        "--workers 1 --out {tmp}/evaluation"
    ),
    "python evaluate.py --tracking": "--episodes 1 --workers 1 --out {tmp}/tracking",
    "python evaluate.py --policies teacher --families stair,gap --episodes 20": (
        "--families gap --levels 6 --episodes 1 --workers 1 --out {tmp}/teacher"
    ),
    "python evaluate.py --trace failed": (
        "--policies gp --levels 10 --families gap --episodes 1 --workers 1 --out {tmp}/trace"
    ),
    "python evaluate.py --policies tdgc --set decoder.vx.high=0.6 --set safety.max_tilt=0.5": (
        "--levels 0 --families rough --episodes 1 --workers 1 --out {tmp}/tune"
    ),
    "python evaluate.py --video --families stair,gap --levels 8": (
        "--policies gp --levels 10 --families gap --episodes 1 --workers 1 --out {tmp}/video"
    ),
    "python -m tdgc.export --low runs/low/calibrated --high runs/high/policy --out runs/export": (
        "--low {tmp}/low/calibrated --high {tmp}/high/policy --format torchscript "
        "--out {tmp}/export"
    ),
    "python -m tdgc.bench --out runs/bench": (
        "--robots 2 --workers 1 --seconds 0.1 --out {tmp}/bench"
    ),
    "python train_low.py --set env.robot.urdf=a1/a1.urdf --set env.robot.base_height=0.27 "
    "--out runs/a1_low": f"{TRAIN} --set env.robot.urdf={{tmp}}/a1/a1.urdf --out {{tmp}}/a1_low",
    "python train_high.py --low runs/a1_low/policy --out runs/a1_high": (
        f"{TRAIN_HIGH} --low {{tmp}}/a1_low/policy --out {{tmp}}/a1_high"
    ),
    "python evaluate.py --families hills.npy": (
        "--families {tmp}/hills.npy --levels 5 --policies gp --episodes 1 --workers 1 --video "
        "--out {tmp}/own"
    ),
    "python train_high.py --init tdgc/pretrained/high "
    """--set 'env.families=["rough","stair","hills.npy"]' --out runs/hills""": (
        """--set 'env.families=["rough","{tmp}/hills.npy"]' --steps 8 --n-envs 2 --workers 1 """
        "--set ppo.n_steps=4 --set ppo.minibatches=1 --out {tmp}/hills"
    ),
}
#: What is in ``{tmp}`` afterwards.
OUTPUTS = (
    "first/summary.json",
    "first/report.html",
    "low/config.json",
    "low/policy.json",
    "low/policy.safetensors",
    "low/calibrated.safetensors",
    "low/checkpoints/step-000000000128",
    "low/checkpoints/step-000000000256",
    "low/tensorboard",
    "high/policy.safetensors",
    "evaluation/episodes.csv",
    "evaluation/summary.json",
    "evaluation/success.png",
    "tracking/tracking.json",
    "teacher/summary.json",
    "trace/diagnosis.csv",
    "trace/traces/gp_nominal_gap_10_000.parquet",
    "tune/tuning.json",
    "video/films/film_gp_nominal_gap_10_000.mp4",
    "video/films/strip_gap_10.png",
    "export/low.pt",
    "export/high_interface.json",
    "a1_low/policy.safetensors",
    "a1_high/policy.safetensors",
    "bench/bench.json",
    "own/trajectories.png",
    "own/films/sheet_gp_nominal_{map}_05_000.png",
    "hills/policy.safetensors",
)
PROGRAMS = {
    "python": [sys.executable],
    ".venv/bin/python": [sys.executable],
    "tensorboard": [sys.executable, "-m", "tensorboard.main"],
}


def blocks(language: str) -> list[str]:
    """README's fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """README's shell commands in order, without comments, a chain taken apart."""
    lines = "".join(blocks("bash")).replace("\\\n", " ").splitlines()
    bare = [re.sub(r"(^|\s)#.*", "", line) for line in lines]
    return [part.strip() for line in bare if line.strip() for part in line.split("&&")]


def rows(heading: str) -> list[list[str]]:
    """Cells of the tables under a heading, without the first one's two head lines."""
    section = README.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_every_command_is_in_the_table() -> None:
    assert list(dict.fromkeys(commands())) == list(COMMANDS)


def test_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    monkeypatch.chdir(tmp_path)
    for code in blocks("python"):
        exec(compile(code, "README.md", "exec"), {})  # they write a robot and a terrain

    def run(commands: list[str]) -> None:
        for command in commands:
            added = str(COMMANDS[command]).format(tmp=tmp_path)
            program, *arguments = shlex.split(f"{command} {added}")
            result = subprocess.run(
                [*PROGRAMS[program], *arguments],
                cwd=ROOT,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=600,
            )
            output = (result.stdout + result.stderr)[-4000:]
            assert result.returncode == 0, f"{command}\n{output}"

    # Two at a time, but those that need what others write, in runs/low and so on, after them.
    chains: dict[str, list[str]] = {}
    for command, added in COMMANDS.items():
        if added is not BY_CI:
            needs = re.search("{tmp}/(low|a1)", added)
            chains.setdefault(needs[1] if needs else command, []).append(command)
    with ThreadPoolExecutor(max_workers=2) as pool:
        list(pool.map(run, chains.values()))
    outputs = [name.format(map=file_label(f"{tmp_path}/hills.npy")) for name in OUTPUTS]
    assert not [name for name in outputs if not (tmp_path / name).exists()]


def test_ci_finds_the_test_command() -> None:
    chains = [
        line for line in README.splitlines() if re.search("^python3 .* -m pytest -n 2$", line)
    ]
    assert len(chains) == 1


def test_table_of_commands_is_the_decoders() -> None:
    decoder = CommandDecoder()
    bounds = zip(decoder.low, decoder.high, strict=True)
    expected = [
        [name, unit, f"{low:g} {'to' if i < 12 else 'or'} {high:g}"]
        for i, (name, unit, (low, high)) in enumerate(
            zip(decoder.names, decoder.units, bounds, strict=True)
        )
    ]
    assert [row[:3] for row in rows("What it is")] == expected


@pytest.mark.parametrize(
    ("heading", "main"), [("Train", train_low.main), ("Evaluate", evaluate.main)]
)
def test_table_of_flags_is_the_scripts(
    heading: str, main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    flags = re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, flags=re.MULTILINE)
    assert [row[0] for row in rows(heading) if re.match("--[a-z]", row[0])] == flags


def test_conditions_are_named() -> None:
    assert not [name for name in CONDITIONS if f"`{name}`" not in README]


def test_map_names_what_is_there() -> None:
    named = {row[0] for row in rows("Repository map")}
    assert not [name for name in named if not (ROOT / name).exists()]
    modules = [*ROOT.glob("*.py"), *(ROOT / "tdgc").rglob("[a-z]*.py")]
    assert not {str(path.relative_to(ROOT)) for path in modules} - named
