"""How robots walk, from traces: shares, headings and means with known answers."""

from pathlib import Path

import numpy as np
import pytest
from test_diagnosis import walk

from tdgc.benchmark.behaviour import MEANS, behaviour, describe
from tdgc.benchmark.trace import Trace
from tdgc.files import read_csv, write_csv


def turned(yaw: float, gaits: tuple[str, str] = ("trot", "trot")) -> Trace:
    """Walks 2 m straight along its tile while facing ``yaw`` rad to the left of that, in one gait
    for the first half and in another for the second."""
    trace = walk(outcome="reached", track=((1.0, 4.0), (3.0, 4.0)))
    trace["yaw"][:] = yaw
    n = len(trace["time"])
    trace["gait"][: n // 2], trace["gait"][n // 2 : -1] = gaits
    trace["command_swing_height"][:-1] = np.where(np.arange(n - 1) < n // 2, 0.1, 0.2)
    trace["roll"][:] = np.where(np.arange(n) % 2, 0.1, -0.1)
    return trace


@pytest.mark.parametrize(
    ("yaw", "sideways", "backward"),
    [(0.3, 0.0, 0.0), (1.2, 1.0, 0.0), (-2.0, 1.0, 0.0), (2.8, 0.0, 1.0), (-3.1, 0.0, 1.0)],
)
def test_the_way_a_robot_faces(yaw: float, sideways: float, backward: float) -> None:
    means = behaviour(turned(yaw)).means
    assert (means["sideways"], means["backward"]) == (sideways, backward)


def test_means_are_over_time() -> None:
    trace = turned(0.0, ("trot", "pronk"))
    found = behaviour(trace)
    length = float(trace["seconds"][1:].sum())
    assert found.means["trot"] + found.means["pronk"] == pytest.approx(1.0)
    assert found.means["trot"] == pytest.approx(0.5, abs=0.03)
    assert found.means["speed"] == pytest.approx(2.0 / length)
    expected = 0.1 * found.means["trot"] + 0.2 * found.means["pronk"]
    assert found.means["swing_height"] == pytest.approx(expected)
    assert found.means["roll"] == pytest.approx(0.1)  # sides do not cancel
    assert (found.family, found.outcome) == ("rough", "reached")


def test_a_robot_that_stands_has_no_heading() -> None:
    still = walk("rough", outcome="timeout", track=((1.0, 4.0), (1.0, 4.0)))
    means = behaviour(still).means
    assert (means["sideways"], means["backward"], means["speed"]) == (0.0, 0.0, 0.0)


def test_the_file_and_the_table(tmp_path: Path) -> None:
    rows = [behaviour(turned(0.0, ("trot", "pace"))), behaviour(turned(1.5, ("bound", "bound")))]
    write_csv(tmp_path / "behaviour.csv", rows[0].row(), (row.row() for row in rows))
    read = read_csv(tmp_path / "behaviour.csv")
    assert [float(row["sideways"]) for row in read] == [0.0, 1.0]
    assert list(read[0])[-len(MEANS) :] == list(MEANS) and read[0]["family"] == "rough"
    head, columns, line = describe(rows).splitlines()
    assert head == f"how {rows[0].policy} walks, nominal"
    assert columns.split()[:6] == ["family", "level", "trot", "pronk", "pace", "bound"]
    assert line.split()[:2] == ["rough", str(rows[0].level)]
    assert line.split()[5] == "50%" and line.split()[6] == "50%"  # bound; sideways
