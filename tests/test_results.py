"""Tables of rates and paired differences, and the files of a results folder."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from tdgc.benchmark.evaluation import Episode
from tdgc.benchmark.intervals import paired_interval
from tdgc.benchmark.results import (
    FILES,
    Training,
    compare,
    describe,
    make_room,
    policies_of,
    robot_changes,
    summarise,
    write_results,
)
from tdgc.config import LowLevelConfig


def row(policy: str, family: str, level: int, episode: int, outcome: str) -> Episode:
    nothing, shares = np.zeros((1, 3)), (1.0, 0.0, 0.0, 0.0)
    where = (policy, "nominal", family, level, episode, 0)
    return Episode(*where, outcome, 1.0, 1.0, 1.0, shares, nothing[0, :2], nothing)


def rows(policy: str, family: str, reached: list[bool]) -> list[Episode]:
    ends = ["reached" if good else "fell" for good in reached]
    return [row(policy, family, 6, k, end) for k, end in enumerate(ends)]


def test_room_is_made_in_a_used_folder(tmp_path: Path) -> None:
    """What an earlier table left goes; files of other names, and folders, stay."""
    for name in ("films/mine", "films/own.txt", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("") if "." in name else (tmp_path / name).mkdir()
    stopped = "films/.film_gp_stair_06_001.mp4.4711.tmp"
    for name in (*FILES, "films/film_gp_stair_06_000.gif", stopped, "settings.json"):
        (tmp_path / name).write_text("")
    make_room(tmp_path, ["settings.json"], {"logs": True, "traces": False})
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == ["films", "films/mine", "films/own.txt", "logs", "notes.txt"]


def test_summary_counts_and_averages() -> None:
    table = summarise(
        [
            row("gp", "rough", 6, 0, "reached"), row("gp", "rough", 6, 1, "fell"),
            row("gp", "rough", 7, 0, "reached"), row("gp", "rough", 7, 1, "reached"),
            row("gp", "gap", 6, 0, "timeout"), row("gp", "gap", 6, 1, "left_tile"),
            row("gp", "gap", 7, 0, "collided"), row("gp", "gap", 7, 1, "reached"),
        ]
    )["gp"]["nominal"]  # fmt: skip
    assert table["rough"]["6"]["rate"] == 0.5 and table["rough"]["mean"]["rate"] == 0.75
    assert table["gap"]["mean"]["reached"] == 1
    assert table["mean"]["n"] == 8 and table["mean"]["rate"] == 0.5
    assert table["mean"]["ci_low"] < 0.5 < table["mean"]["ci_high"]


#: Of 10 tiles of rough, tdgc gains 3 and loses 1; of 40 tiles of gap, it loses 30.
EPISODES = [
    *rows("tdgc", "rough", [True] * 6 + [False] * 1 + [False] * 3),
    *rows("gp", "rough", [True] * 3 + [False] * 3 + [True] * 1 + [False] * 3),
    *rows("tdgc", "gap", [True] * 10 + [False] * 30),
    *rows("gp", "gap", [True] * 40),
]


def test_differences_are_paired_by_tile() -> None:
    found = compare(reversed(EPISODES), "tdgc", "gp")["nominal"]
    assert list(found) == ["gap", "rough", "mean"]
    rough = {key: found["rough"][key] for key in ("n", "gained", "lost", "difference")}
    assert rough == {"n": 10, "gained": 3, "lost": 1, "difference": pytest.approx(0.2)}
    interval = found["rough"]["ci_low"], found["rough"]["ci_high"]
    assert interval == paired_interval(3, 3, 1, 3)
    assert found["gap"]["difference"] == pytest.approx(-0.75) and found["gap"]["ci_high"] < -0.5
    assert found["mean"]["n"] == 50 and found["mean"]["difference"] == pytest.approx(-28 / 50)
    with pytest.raises(ValueError, match="tdgc and gp were not on the same tiles"):
        compare(EPISODES[1:], "tdgc", "gp")


def test_the_summary_has_the_differences_beside_the_policies(tmp_path: Path) -> None:
    write_results(tmp_path, EPISODES)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert list(summary) == ["tdgc", "gp", "paired"]
    assert summary["paired"] == {"tdgc - gp": compare(EPISODES, "tdgc", "gp")}
    write_results(tmp_path, [e for e in EPISODES if e.policy == "gp"])
    assert list(json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))) == ["gp"]


def test_mirror_images_are_compared_with_their_tiles(tmp_path: Path) -> None:
    tilt = rows("tdgc", "tilt", [True, True, True, False])
    images = [
        dataclasses.replace(e, condition="mirrored", outcome=outcome)
        for e, outcome in zip(tilt, ("reached", "fell", "fell"), strict=False)
    ]
    rough = rows("tdgc", "rough", [True])
    images.append(dataclasses.replace(rough[0], condition="mirrored"))
    found = write_results(tmp_path, [*images, *rough, *tilt])
    assert list(found["sides"]) == ["tdgc"]
    assert list(found["sides"]["tdgc"]) == ["tilt", "rough", "mean"]
    one = found["sides"]["tdgc"]["tilt"]  # of the tiles that have an image
    assert (one["n"], one["gained"], one["lost"]) == (3, 0, 2)
    assert found["sides"]["tdgc"]["mean"]["difference"] == pytest.approx(-0.5)
    lines = describe(found).splitlines()
    at = lines.index("tdgc on mirrored tiles - on the tiles")
    assert lines[at + 1].split()[:2] == ["tilt", "-66.7"]


def test_the_table_says_which_edition_a_policy_was_trained_on(tmp_path: Path) -> None:
    found = describe(write_results(tmp_path, EPISODES, Training({"low": 1, "high": 2})))
    assert found.endswith(
        "the low policy was trained on edition 1 of TDGC-Bench, these tiles are of edition 2"
    )
    assert "the high policy" not in found
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["editions"] == {"tiles": 2, "low": 1, "high": 2}


def test_the_table_says_what_differs_from_the_benchmarks_robot(tmp_path: Path) -> None:
    """Its motors, gains and control step are named, but nothing that belongs to the low policy, and
    no physics that the evaluation replaces."""
    config = LowLevelConfig()
    assert robot_changes(config) == []
    robot = dataclasses.replace(config.robot, kp=18.6, action_scale=0.5, joint_margin=None)
    physics = dataclasses.replace(config.physics, control_dt=0.01, hold=1, friction=1.2)  # replaced
    changes = robot_changes(dataclasses.replace(config, robot=robot, physics=physics))
    assert changes == ["robot.kp=18.6, not 20.0", "physics.control_dt=0.01, not 0.02"]
    summary = write_results(tmp_path, EPISODES, Training({"low": 2, "high": 2}, changes))
    assert summary["robot"] == changes and list(policies_of(summary)) == ["tdgc", "gp"]
    assert describe(summary).splitlines()[-4:] == [
        "", "not the benchmark's robot:", f"  {changes[0]}", f"  {changes[1]}",
    ]  # fmt: skip
    usual = write_results(tmp_path, EPISODES, Training({"low": 2, "high": 2}))
    assert "robot" not in usual and "robot" not in describe(usual)


def test_policies_on_other_tiles_are_not_compared(tmp_path: Path) -> None:
    """A stopped evaluation left ``gp`` without a tile; only ``tdgc`` and ``cues`` are compared."""
    cues = [dataclasses.replace(e, policy="cues") for e in EPISODES if e.policy == "tdgc"]
    found = write_results(tmp_path, [*EPISODES[:-1], *cues])
    assert list(found["paired"]) == ["tdgc - cues"]
    assert list(found) == ["tdgc", "gp", "cues", "paired"]
    assert "paired" not in write_results(tmp_path, EPISODES[:-1])


def test_the_table_has_gaps_where_cells_are_missing(tmp_path: Path) -> None:
    some = [*rows("gp", "rough", [True]), row("gp", "rough", 7, 0, "fell")]
    lines = describe(write_results(tmp_path, [*some, *rows("gp", "gap", [True])])).splitlines()
    assert [line.split() for line in lines[1:5]] == [
        ["gp,", "nominal"],
        ["family", "6", "7", "mean"],
        ["rough", "100.0%", "0.0%", "50.0%"],
        ["gap", "100.0%", "-", "100.0%"],
    ]
    assert len({len(line) for line in lines[2:5]}) == 1  # aligned in columns


def test_results_that_cannot_be_written_leave_those_of_before(tmp_path: Path) -> None:
    write_results(tmp_path, EPISODES)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == set(FILES)
    with pytest.raises(ValueError):
        write_results(tmp_path, [EPISODES[0], dataclasses.replace(EPISODES[1], shares=(1.0,))])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_table_says_where_dominance_fails(tmp_path: Path) -> None:
    lines = describe(write_results(tmp_path, EPISODES)).splitlines()
    at = lines.index("tdgc - gp on the same tiles, nominal")
    low, high = (100 * end for end in paired_interval(3, 3, 1, 3))
    assert lines[at + 1].split() == ["rough", "+20.0", f"[{low:+.1f},", f"{high:+.1f}]"]
    assert lines[at + 2].startswith("gap") and lines[at + 2].endswith("  below gp")
    assert lines[at + 3].startswith("mean") and lines[at + 3].endswith("  below gp")
    assert lines[1] == "tdgc, nominal" and "paired" not in lines
