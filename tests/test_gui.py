"""The GUI: sliders become commands; without a display the script prints a line and returns."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

import evaluate
from tdgc.benchmark import evaluation
from tdgc.benchmark.drivers import BaselineDriver
from tdgc.benchmark.evaluation import Cell, tile_of
from tdgc.config import ConfigError, LowLevelConfig
from tdgc.policies import Policy
from tdgc.show import gui
from tdgc.show.gui import describe, slider_command
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.display import WindowError, check_display
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.sim.robot import Array
from tdgc.tasks.rules import FELL, GOING


def test_sliders_are_the_commands() -> None:
    values = np.append(np.arange(12.0), 0.0)
    assert slider_command(values)[:12].tolist() == list(range(12))
    for place, gait in ((0.0, 0), (0.49, 0), (0.51, 1), (2.2, 2), (3.0, 3)):
        values[12] = place
        assert slider_command(values)[12:].tolist() == GAIT_TABLE[gait].tolist()
    with pytest.raises(ValueError, match="gait index"):
        slider_command(np.append(np.zeros(12), 3.6))


def test_the_text_says_gait_and_velocities() -> None:
    command = default_command()
    command[INDEX["vx"]], command[12:] = -0.25, GAIT_TABLE[GAITS.index("bound")]
    text = describe(command)
    assert text == "bound, vx -0.25 m/s, vy 0.00 m/s, yaw_rate 0.00 rad/s"


def test_who_drives_needs_no_high_policy_that_fits(low: tuple[Policy, LowLevelConfig]) -> None:
    """The low policy may be of a robot that the shipped high policy does not know."""
    driving = evaluate.Evaluation.of(evaluate.parse(["--gui", "drive", "--workers", "1"]))
    policy, config = low
    other = dataclasses.replace(config, robot=dataclasses.replace(config.robot, kp=30.0))
    assert driving.drivers(policy, other) == {}
    with pytest.raises(ConfigError, match=r"trained for a low policy with robot.kp 20.0, not 30.0"):
        dataclasses.replace(driving, mode="watch").drivers(policy, other)


@pytest.mark.parametrize("display", ["", ":4711"])
@pytest.mark.parametrize("mode", ["drive", "watch"])
def test_no_display(
    mode: str, display: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An empty ``DISPLAY`` and one that does not exist are refused in one line."""
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(WindowError):
        check_display()
    driver = ["--policies", "gp"] if mode == "watch" else []
    assert evaluate.main(["--gui", mode, *driver]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("evaluate.py: a window needs ")


class Pane:
    """Stands in for Bullet's window.

    It is closed after the last of the sliders' ``values``, and when it has shown ``texts`` texts.
    """

    def __init__(self, values: Sequence[Array] = (), texts: int = 100) -> None:
        self._values, self._most = iter(values), texts
        self.sliders: list[str] = []
        self.seen: list[Array] = []
        self.texts: list[str] = []
        self.closed = False

    def add_slider(self, name: str, low: float, high: float, start: float) -> None:
        self.sliders.append(name)

    def read_sliders(self) -> Array:
        for values in self._values:
            return values
        raise WindowError("the window was closed")

    def show(self, position: Array, quaternion: Array, q: Array) -> None:
        self.seen.append(position.copy())

    def follow(self, text: str) -> None:
        self.texts.append(text)
        if len(self.texts) == self._most:
            raise WindowError("the window was closed")

    def close(self) -> None:
        self.closed = True

    def open(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Be the window that ``gui`` opens, which then does not run in real time."""
        clock = SimpleNamespace(sleep=lambda _: None, perf_counter=time.perf_counter)
        monkeypatch.setattr(gui, "set_stage", lambda *_, **__: self)
        monkeypatch.setattr(gui, "time", clock)


@pytest.mark.parametrize("reason", ["the button", "a fall"])
def test_the_robot_returns_to_the_start(
    reason: str, low: tuple[Policy, LowLevelConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After it has walked ahead for a second. Closing the window is the normal end."""
    ahead = np.append(default_command()[:12], [0.0, 0.0])  # trot; the button is not pressed
    ahead[INDEX["vx"]] = 0.6
    pressed = np.append(ahead[:-1], 1.0)
    pane, worlds = Pane([*[ahead] * 50, pressed if reason == "the button" else ahead]), []
    pane.open(monkeypatch)
    close = BulletWorld.close
    monkeypatch.setattr(BulletWorld, "close", lambda world: worlds.append(world) or close(world))
    if reason == "a fall":
        down = lambda world: np.array([FELL if len(pane.seen) == 50 else GOING])  # noqa: E731
        monkeypatch.setattr(gui, "outcome", down)
    gui.drive(low[0], Cell("gp", "nominal", "rough", 0, 0, 1), 0)
    x, y, _ = tile_of(0, "rough", 0, 0).start
    away = [np.hypot(place[0] - x, place[1] - y) for place in pane.seen]
    assert len(away) == 51 and away[49] > 0.2 and away[50] < 0.01
    assert pane.sliders[0] == "vx (m/s)" and len(pane.sliders) == 14
    assert pane.closed and len(worlds) == 1


def test_watching_shows_the_episode_and_then_its_outcome(
    low: tuple[Policy, LowLevelConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "HORIZON", 0.3)
    pane = Pane(texts=5)  # three in the episode
    pane.open(monkeypatch)
    gui.watch(low[0], BaselineDriver(), Cell("gp", "nominal", "rough", 0, 0, 1), 0)
    assert len(pane.seen) == 15 and pane.closed
    assert pane.texts[0].startswith("trot, vx 0.") and pane.texts[3:] == ["timeout"] * 2
