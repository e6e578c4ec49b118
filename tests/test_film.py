"""Films show what was recorded, on the right tile; without an encoder only MP4s are missing."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

import evaluate
from tdgc.benchmark import evaluation
from tdgc.benchmark.drivers import BaselineDriver
from tdgc.benchmark.evaluation import Batch, Cell, run_cell, tile_of
from tdgc.benchmark.recording import Recorder, Recording, runs_of_equal, spans
from tdgc.config import CommandRanges, LowLevelConfig, RobotConfig
from tdgc.files import read_csv
from tdgc.policies import Policy
from tdgc.show import film, plots
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import gait_embedding
from tdgc.sim.robot import Array, nominal_pose

pytestmark = pytest.mark.usefixtures("in_process")


def planted(steps: int = 25, policy: str = "gp", **changes: Any) -> Recording:
    """A recording of ``steps`` steps: a robot glides along a tile with its legs still."""
    tile = tile_of(0, "gap", 8, 0)
    position = np.tile([*tile.start[:2], 0.32], (steps, 1))
    position[:, 0] += 0.01 * np.arange(steps)
    command = np.tile(default_command(), (steps, 1))
    command[steps // 2 :, 12:] = gait_embedding(3)
    contact = np.zeros((steps, 4), dtype=bool)
    recording = Recording(
        policy, "nominal", "gap", 8, 0, 0, "fell",
        robot=RobotConfig(),
        dt=0.02,
        bounds=np.array(dataclasses.astuple(CommandRanges())),
        position=position,
        quaternion=np.tile([0.0, 0.0, 0.0, 1.0], (steps, 1)),
        q=np.tile(nominal_pose(RobotConfig()), (steps, 1)),
        command=command,
        velocity=np.tile([0.5, 0.0, 0.0], (steps, 1)),
        height=np.full(steps, 0.32),
        contact=contact,
        desired=contact.copy(),
    )  # fmt: skip
    return dataclasses.replace(recording, **changes)


def is_colour(pixels: Array, colour: Sequence[int], tolerance: int = 2) -> Array:
    """Whether each of the pixels (..., 3) is within ``tolerance`` of ``colour``, (...)."""
    return (np.abs(pixels.astype(int) - np.array(colour)) <= tolerance).all(axis=-1)


# ------------------------------------------------------------------ recordings


class Notes:
    """A watcher that keeps what the recorder should keep of episode 1."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Array]] = []

    def begin(self, batch: Batch) -> None:
        self._loco, self._origin = batch.loco, batch.field.origin(1)

    def step(self, step: int, live: Array) -> None:
        state = self._loco.world.state
        if 1 in live:
            self.rows.append(
                {
                    "position": state.position[1] - [*self._origin, 0.0],
                    "q": state.q[1].copy(),
                    "command": self._loco.carried_out[1].copy(),
                    "height": self._loco.world.trunk_height()[1],
                    "contact": state.foot_force[1] > 1.0,
                    "desired": self._loco.clock.contact[1] > 0.5,
                    "quaternion": state.quaternion[1].copy(),
                    "velocity": np.append(state.heading_vel[1, :2], state.ang_vel[1, 2]),
                }
            )


def test_a_recording_is_the_episode(
    low: tuple[Policy, LowLevelConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It equals what another watcher sees, and recording does not change the episode."""
    monkeypatch.setattr(evaluation, "HORIZON", 0.4)
    driver = BaselineDriver()
    cell, notes, recorder = Cell("gp", "nominal", "rough", 9, 0, 3), Notes(), Recorder(driver, 2)
    watched = run_cell(cell, low[0], driver, 5, [notes, recorder])
    alone = run_cell(cell, low[0], BaselineDriver(), 5)
    assert [e.row() for e in watched] == [e.row() for e in alone]
    first, second = recorder.recordings()
    assert [first.name, second.name] == ["gp_nominal_rough_09_000", "gp_nominal_rough_09_001"]
    assert second.outcome == watched[1].outcome == "timeout" and second.ending == "timeout, 0.4 s"
    assert len(second.command) == 20
    assert second.command[0, INDEX["frequency"]] == pytest.approx(3.5)  # as a gait begins
    for key in notes.rows[0]:
        assert np.array_equal(getattr(second, key), [row[key] for row in notes.rows]), key
    assert second.contact.any() and second.desired.any() and not second.contact.all()
    # The recorded speed over ground, in any direction, fits the change of position.
    steps = np.diff(second.position[:, :2], axis=0)
    speed = np.linalg.norm(second.velocity[:, :2], axis=1)[1:]
    assert np.linalg.norm(steps, axis=1) == pytest.approx(0.02 * speed, rel=0.35, abs=2e-3)


def test_only_the_first_episodes_are_recorded(
    low: tuple[Policy, LowLevelConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    driver = BaselineDriver()
    for first, count, numbers in ((0, 1, [0]), (1, 3, [1, 2]), (1, 1, [])):
        recorder = Recorder(driver, count)
        run_cell(Cell("gp", "nominal", "rough", 0, first, 2), low[0], driver, 0, [recorder])
        assert [r.episode for r in recorder.recordings()] == numbers


def test_bars_of_contact() -> None:
    flags = np.array([1, 1, 0, 0, 1, 0, 1, 1, 1], dtype=bool)
    assert spans(flags) == [(0, 2), (4, 5), (6, 9)]
    assert spans(np.zeros(3, dtype=bool)) == [] and spans(np.ones(3, dtype=bool)) == [(0, 3)]
    assert runs_of_equal(np.array([2, 2, 0, 0, 0, 2])) == [(0, 2, 2), (2, 5, 0), (5, 6, 2)]
    assert runs_of_equal(np.array([1])) == [(0, 1, 1)]


# ------------------------------------------------------------------ frames


def test_the_diagram_shows_the_contacts_that_were_planted() -> None:
    """150 steps fill its 3 s; dark bars mark each foot's contacts, pale ones those desired."""
    rng, steps = np.random.default_rng(0), 150
    contact = np.repeat(rng.random((steps // 10, 4)) < 0.5, 10, axis=0)
    recording = planted(steps, contact=contact, desired=~contact)
    frame = film.Overlay(recording).frame(Image.new("RGB", (660, 420)), steps - 1)
    pixels = np.asarray(frame)
    assert frame.size == film.SIZE
    left, right = 44, film.SIZE[0] - 14
    middle = left + (right - left) * (np.arange(steps) + 0.5) / steps
    # Steps at the border of a bar share a pixel with the next step.
    inside = (np.arange(steps) % 10 > 0) & (np.arange(steps) % 10 < 9)
    for foot in range(4):
        row = pixels[420 + 8 + 12 + 20 * foot + 8][middle.astype(int)]
        dark, pale = is_colour(row, (30, 34, 40)), is_colour(row, (176, 205, 235))
        assert (dark == contact[:, foot])[inside].all()
        assert (pale == ~contact[:, foot])[inside].all()
    # The band above them shows the gait: trot in the first half, bound in the second.
    band = pixels[420 + 8 + 3][middle.astype(int)]
    for gait, half in ((0, slice(0, 70)), (3, slice(80, 150))):
        colour = plots.GAIT_COLOURS[gait]
        wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        assert is_colour(band, wanted)[half].all()


def test_a_young_film_has_a_diagram_that_is_empty_at_the_left() -> None:
    recording = planted(30, contact=np.ones((30, 4), dtype=bool))
    pixels = np.asarray(film.Overlay(recording).frame(Image.new("RGB", (660, 420)), 29))
    dark = np.flatnonzero(is_colour(pixels[420 + 28], (30, 34, 40)))
    dark = dark[dark >= 44]
    begin = 44 + (film.SIZE[0] - 14 - 44) * 0.8  # the 0.6 s fill the last fifth of 3 s
    assert dark.min() == pytest.approx(begin, abs=2) and dark.max() == pytest.approx(946, abs=2)


def test_the_camera_is_smooth_and_stays_with_the_base() -> None:
    recording = planted(100)
    shaken = recording.position.copy()
    shaken[:, 2] += 0.03 * (-1.0) ** np.arange(100)
    way = film.camera_way(dataclasses.replace(recording, position=shaken))
    assert way.shape == (100, 3)
    assert np.abs(np.diff(way[:, 2])).max() < 0.1 * 0.06
    assert way[30:70, 0] == pytest.approx(recording.position[30:70, 0])
    assert np.linalg.norm(way - recording.position, axis=1).max() < 0.3


def test_the_goal_is_painted_where_it_is() -> None:
    tile = tile_of(0, "gap", 8, 0)
    pixels = np.asarray(film.ground_picture(tile, way=np.array([[1.0, 2.0], [3.0, 2.0]])))
    n = len(pixels)
    rows, columns = np.nonzero(is_colour(pixels, (0, 140, 90)))
    x, y = (n - columns.mean()) * 8.0 / n, rows.mean() * 8.0 / n
    assert [x, y] == pytest.approx(tile.goal, abs=0.02)
    assert np.ptp(rows) * 8.0 / n == pytest.approx(1.0, abs=0.03)
    rows, columns = np.nonzero(is_colour(pixels, (0, 0, 0)))
    assert (n - columns.max()) * 8.0 / n == pytest.approx(1.0, abs=0.03)
    assert rows.mean() * 8.0 / n == pytest.approx(2.0, abs=0.02)


def test_the_stage_shows_the_painted_goal_under_its_pole() -> None:
    """Bullet maps the picture onto the tile in the right orientation."""
    recording = planted()
    with film.staged(recording) as stage:
        goal = np.append(tile_of(0, "gap", 8, 0).goal, 0.0)
        above = stage.picture(0, 201, 201, elevation=1.5, distance=2.0, target=goal)
        stage.show(goal + [0.0, 0.0, 0.32], recording.quaternion[0], recording.q[0])
        hidden = stage.picture(0, 201, 201, elevation=1.5, distance=2.0, target=goal)
    rows, columns = np.nonzero(is_colour(above, (0, 140, 90), 30))
    assert [rows.mean(), columns.mean()] == pytest.approx([100, 100], abs=6)
    assert np.ptp(columns) == pytest.approx(1.0 / 1.66 * 201, abs=12)  # 2 m away, FOV 45 degrees
    assert (above != hidden).any(axis=-1).mean() > 0.05  # the robot came into view


# ------------------------------------------------------------------ files


def test_a_film_can_be_decoded(tmp_path: Path) -> None:
    recording = planted(9)
    film.film(recording, tmp_path)
    frames = 5 + 25  # steps 0, 2, 4, 6 and the last, which is held for a second
    with av.open(str(tmp_path / "film_gp_nominal_gap_08_000.mp4")) as file:
        stream = file.streams.video[0]
        assert stream.average_rate == 25 and (stream.width, stream.height) == film.SIZE
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert len(pictures) == frames
    direct = [np.asarray(frame) for frame in film.frames(recording)]
    for one, other in zip(pictures, direct, strict=True):
        assert np.abs(one.astype(int) - other).mean() < 4.0  # up to compression
    assert (direct[0] != direct[4]).any(axis=-1)[:420, :660].mean() > 0.005
    with Image.open(tmp_path / "film_gp_nominal_gap_08_000.gif") as gif:
        assert gif.size == (film.SIZE[0] // 2, film.SIZE[1] // 2)
        times = []
        for k in range(gif.n_frames):
            gif.seek(k)
            times.append(gif.info["duration"])
    assert times[:2] == [80, 80] and sum(times) == 80 * frames // 2
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".gif", ".mp4"]


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"condition": "friction-0.4"}, "film_gp_friction-0.4_gap_08_000"),
        ({"family": "hills.npy", "level": 3}, "film_gp_nominal_hills.npy_03_000"),
    ],
)
def test_a_films_name_is_kept_whole(
    changes: dict[str, Any], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report looks for it; cut at a dot, films would overwrite each other."""
    monkeypatch.chdir(tmp_path)
    np.save("hills.npy", np.zeros((161, 161)))
    films = tmp_path / "films"
    films.mkdir()
    film.film(planted(2, **changes), films)
    assert sorted(path.name for path in films.iterdir()) == [f"{name}.gif", f"{name}.mp4"]


def test_a_film_that_fails_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_off(recording: Recording) -> Any:
        yield Image.new("RGB", film.SIZE)
        raise OSError("no space left on device")

    monkeypatch.setattr(film, "frames", break_off)
    with pytest.raises(OSError, match="no space"):
        film.film(planted(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_strip_shows_all_policies_on_one_tile(tmp_path: Path) -> None:
    ours = planted(31, "tdgc", outcome="reached")
    path = film.strip([ours, planted(31)], tmp_path)
    assert path == tmp_path / "strip_gap_8.png"
    pixels = np.asarray(Image.open(path))
    shots = [
        [pixels[40 + 266 * row :][:260, 112 + 406 * k :][:, :400] for k in range(5)]
        for row in range(2)
    ]
    # Both begin at the same place on the same tile, so only the drawn paths differ.
    assert (shots[0][0] != shots[1][0]).any(axis=-1).mean() < 0.05
    assert (shots[1][0] != shots[1][4]).any(axis=-1).mean() > 0.05
    assert film.moments(ours) == [0, 8, 15, 22, 30]
    with pytest.raises(ValueError, match="a strip shows one tile, not 2"):
        film.strip([ours, planted(family="stair")], tmp_path)
    assert film.strip([planted(condition="pushes")], tmp_path).name == "strip_gap_8_pushes.png"


def test_a_sheet_has_the_bars_that_were_planted(tmp_path: Path) -> None:
    """All feet are in contact in the first half only, so the black bars cover just that half."""
    for name, share in (("none", 0.0), ("half", 0.5)):
        contact = np.zeros((100, 4), dtype=bool)
        contact[: round(100 * share)] = True
        plots.sheet(planted(100, contact=contact), tmp_path / f"{name}.png")
    none, half = (
        np.asarray(Image.open(tmp_path / f"{n}.png").convert("RGB")) for n in ("none", "half")
    )
    rows, columns = np.nonzero((none != half).any(axis=-1))
    assert (half[rows, columns] == 0).mean() > 0.95
    axes = 0.11 * half.shape[1], 0.985 * half.shape[1]
    assert columns.min() == pytest.approx(axes[0], abs=3)
    assert columns.max() == pytest.approx(np.mean(axes), abs=3)
    trot, bound = (
        is_colour(half, [int(plots.GAIT_COLOURS[g][k : k + 2], 16) for k in (1, 3, 5)]).sum()
        for g in (0, 3)
    )
    assert trot == pytest.approx(bound, rel=0.05) and trot > 1000


# ------------------------------------------------------------------ the script


def evaluate_short(out: Path, monkeypatch: pytest.MonkeyPatch, *flags: str) -> int:
    """Run the script in this process: two policies, one cell each, episodes of 0.1 s."""
    monkeypatch.setattr(evaluation, "HORIZON", 0.1)
    monkeypatch.setattr(film, "ENDING_SECONDS", 0.04)
    small = ["--levels", "10", "--families", "gap", "--episodes", "2", "--workers", "1"]
    return evaluate.main([*small, "--out", str(out), *flags])


def test_video_writes_films_sheets_and_a_strip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "film_of_yesterday.gif").touch()
    assert evaluate_short(tmp_path, monkeypatch, "--video") == 0
    names = [f"{p}_nominal_gap_10_000" for p in ("tdgc", "gp")]
    expected = {f"film_{n}.{e}" for n in names for e in ("mp4", "gif")}
    expected |= {f"sheet_{n}.png" for n in names} | {"strip_gap_10.png"}
    assert {path.name for path in (tmp_path / "films").iterdir()} == expected


def test_without_an_encoder_all_but_mp4_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "av" else find(name, *a)
    )
    assert evaluate_short(tmp_path, monkeypatch, "--video", "--policies", "gp") == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == (
        "evaluate.py: MP4 needs av: install the extra 'video', "
        "pip install -c constraints.txt -e '.[video]'"
    )
    assert len(read_csv(tmp_path / "episodes.csv")) == 2
    names = {path.name for path in (tmp_path / "films").iterdir()}
    stem = "gp_nominal_gap_10_000"
    assert names == {f"film_{stem}.gif", f"sheet_{stem}.png", "strip_gap_10.png"}


def test_what_cannot_be_drawn_is_a_line_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The table, and what can be drawn, are there all the same."""

    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(film, "film", full)
    monkeypatch.setattr(evaluate.report, "write", full)
    assert evaluate_short(tmp_path, monkeypatch, "--video", "--policies", "gp") == 1
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if line.startswith("evaluate.py")] == [
        "evaluate.py: no film of gp_nominal_gap_10_000: No space left on device",
        "evaluate.py: no report.html: No space left on device",
    ]
    assert (tmp_path / "films" / "strip_gap_10.png").is_file()
    assert (tmp_path / "summary.json").is_file()
