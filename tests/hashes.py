"""Hashes of what a refactoring must not change: episodes, trained policies and an exported graph.

    python -m tests.hashes

Run it before and after on the same machine, and compare the lines: PyTorch's kernels differ between
CPUs, and with them the last bits of all results. It takes two minutes on two cores.
"""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

import train_high
import train_low
from tdgc import export
from tdgc.benchmark.drivers import BaselineDriver, Driver, HierarchyDriver, load_high
from tdgc.benchmark.evaluation import Cell, run_cell
from tdgc.deploy.controller import Controller
from tdgc.sim.families import FAMILIES
from tdgc.tasks.pairing import PRETRAINED, load_low

_LOW = [
    "--seed", "5", "--n-envs", "20", "--workers", "2", "--steps", "9600",
    "--set", "ppo.n_steps=24", "--set", "calibration.robots=0",
]  # fmt: skip
_HIGH = [
    "--low", str(PRETRAINED / "low"), "--seed", "5", "--n-envs", "20", "--workers", "2",
    "--steps", "4800", "--set", "ppo.n_steps=12", "--set", "imitation.steps=2400",
    "--set", "imitation.teacher={}",
]  # fmt: skip


def episodes(families: Sequence[str] = FAMILIES, count: int = 2) -> str:
    """Episodes of ``tdgc`` and ``gp`` with noise, and how each moved, on level 8."""
    low, config = load_low(PRETRAINED / "low")
    digest = hashlib.sha256()
    drivers: dict[str, Driver] = {
        "tdgc": HierarchyDriver(*load_high(PRETRAINED / "high", low, config)),
        "gp": BaselineDriver(),
    }
    for family in families:
        for name, driver in drivers.items():
            for episode in run_cell(Cell(name, "noise", family, 8, 0, count), low, driver, 3):
                digest.update(repr(episode.row()).encode() + episode.track.tobytes())
    return digest.hexdigest()


def training(main: Callable[[list[str]], int], flags: Sequence[str]) -> str:
    """The policy that a script trains in 20 updates."""
    with tempfile.TemporaryDirectory() as folder:
        assert main([*flags, "--out", folder]) == 0
        return hashlib.sha256((Path(folder) / "policy.safetensors").read_bytes()).hexdigest()


def graphs(steps: int = 100) -> str:
    """Joint targets of the exported pair, in ONNX Runtime, for random readings."""
    rng, digest = np.random.default_rng(0), hashlib.sha256()
    with tempfile.TemporaryDirectory() as folder:
        pair = export.load_pair(PRETRAINED / "low", PRETRAINED / "high")
        export.write(pair, Path(folder), ["onnx"])
        controller = Controller(Path(folder))
        sizes = {
            signal["name"]: signal["shape"]
            for graph in (controller.low, controller.high)
            for signal in graph.table["inputs"]
        }
        for _ in range(steps):
            readings = {name: rng.normal(scale=0.3, size=shape) for name, shape in sizes.items()}
            digest.update(controller.step(readings).tobytes())
    return digest.hexdigest()


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Keep progress bars of the trainings out of the lines to compare."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        with contextlib.redirect_stdout(nowhere):
            yield


def main() -> None:
    print(f"episodes    {episodes()[:16]}")
    for name, script, flags in (
        ("train_low ", train_low.main, _LOW),
        ("train_high", train_high.main, _HIGH),
    ):
        with _silenced():
            found = training(script, flags)
        print(f"{name}  {found[:16]}")
    print(f"graphs      {graphs()[:16]}")


if __name__ == "__main__":
    main()
