"""The GUI: sliders become commands; without a display the script prints a line and returns."""

from __future__ import annotations

import numpy as np
import pytest

import evaluate
from tdgc.show.gui import describe, slider_command
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.sim.world import WindowError, check_display


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
    assert evaluate.main(["--gui", mode, "--policies", "gp"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("evaluate.py: Bullet's window needs ")
