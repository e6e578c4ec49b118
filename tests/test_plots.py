"""Figures come out of files, also at the ends of the scale."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import numpy as np

from tdgc import plots
from tdgc.evaluation import Episode, summarise


def test_success_figure_with_rates_of_none_and_all(tmp_path: Path) -> None:
    rows = [
        Episode(policy, "nominal", family, level, k, 0, outcome, 1.0, 1.0)
        for policy, outcome in (("gp", "fell"), ("tdgc", "reached"))
        for family in ("rough", "gap")
        for level in (6, 7)
        for k in range(10)
    ]
    (tmp_path / "summary.json").write_text(json.dumps(summarise(rows)), encoding="utf-8")
    plots.success_by_level(tmp_path / "summary.json", tmp_path / "success.png")
    picture = matplotlib.image.imread(tmp_path / "success.png")
    assert picture.shape[0] > 200 and picture.shape[1] > picture.shape[0]
    assert np.ptp(picture[..., :3]) == 1.0  # something was drawn on white


def test_training_figure_skips_what_a_phase_does_not_log(tmp_path: Path) -> None:
    plane = {"steps": 100_000, "reward/total": 0.001, "tracking/trot_contact_match": 0.5}
    tiles = {"steps": 200_000, "reward/total": 0.002, "level/stair": 1.5}
    log = tmp_path / "log.jsonl"
    log.write_text(f"{json.dumps(plane)}\n{json.dumps(tiles)}\n", encoding="utf-8")
    plots.training_curve(log, tmp_path / "training.png")
    assert matplotlib.image.imread(tmp_path / "training.png").shape[2] == 4
