"""The GUI: sliders become commands; without a display the script prints a line and returns."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import evaluate
from tdgc.config import ConfigError
from tdgc.show.gui import describe, slider_command
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.display import WindowError, check_display
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.tasks.pairing import PRETRAINED, load_low


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


def test_who_drives_needs_no_high_policy_that_fits() -> None:
    """The low policy may be of a robot that the shipped high policy does not know."""
    driving = evaluate.Evaluation.of(evaluate.parse(["--gui", "drive", "--workers", "1"]))
    low, config = load_low(PRETRAINED / "low")
    other = dataclasses.replace(config, robot=dataclasses.replace(config.robot, kp=30.0))
    assert driving.drivers(low, other) == {}
    with pytest.raises(ConfigError, match=r"trained for a low policy with robot.kp 20.0, not 30.0"):
        dataclasses.replace(driving, mode="watch").drivers(low, other)


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
