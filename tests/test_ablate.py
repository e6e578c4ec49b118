"""The ablation: every variant can be trained, trials resume, and the table is correct."""

import itertools
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch as th

import evaluate
import train_high
from tdgc import policies
from tdgc.ablate import trials
from tdgc.ablate.__main__ import choose, main, plan, without_missing
from tdgc.ablate.table import describe, rows
from tdgc.ablate.trials import Found, Result, Runner, Trial, changed_pair
from tdgc.ablate.variants import HELPS, VARIANTS, WHOLE, Variant, variants
from tdgc.benchmark import evaluation
from tdgc.config import NO_TEACHER, HighLevelConfig, HighTrainConfig, LowLevelConfig, with_overrides
from tdgc.errors import StoppedError
from tdgc.learn.recurrent import FastRecurrentPolicy
from tdgc.learn.run import Interruption, sole_user
from tdgc.policies.correction import Correction
from tdgc.sim.commands import NUM_ACTIONS
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.high_observation import high_mirror
from tdgc.tasks.pairing import PRETRAINED, paired

ROOT = Path(__file__).resolve().parents[1]
LOW = PRETRAINED / "low"

pytestmark = pytest.mark.usefixtures("signals")


def named(name: str) -> Variant:
    return next(variant for variant in VARIANTS + HELPS if variant.name == name)


# ------------------------------------------------------------------ variants


@pytest.mark.parametrize("alone", [False, True])
def test_every_variant_changes_one_thing_and_fits_the_low_policy(alone: bool) -> None:
    base = with_overrides(HighTrainConfig(), NO_TEACHER if alone else ())
    low = LowLevelConfig()  # the MDP of a policy trained by train_low.py
    seen = []
    for variant in variants(alone):
        if variant.settings is not None:
            settings = variant.settings + (variant.alone if alone else ())
            config = with_overrides(base, settings)
            high_mirror(paired(config.env, low))
            seen.append(config)
    assert seen[0] == base and all(config != base for config in seen[1:])
    assert all(a != b for i, a in enumerate(seen) for b in seen[:i])
    names = [variant.name for variant in variants(alone)]
    assert len(set(names)) == len(names) and ("no-teacher" in names) != alone


def test_discounts_are_per_second() -> None:
    for name, seconds in (("50hz", 0.02), ("5hz", 0.2)):
        config = with_overrides(HighTrainConfig(), named(name).settings or ())
        assert config.env.decimation * 0.02 == pytest.approx(seconds)
        assert config.ppo.gamma ** (1.0 / seconds) == pytest.approx(0.99**10, rel=1e-4)
        assert config.ppo.gae_lambda ** (1.0 / seconds) == pytest.approx(0.95**10, rel=1e-4)


def test_the_feed_forward_variant_has_as_many_parameters() -> None:
    task = NavigationTask(HighLevelConfig(families=("rough",)), policies.load(LOW), 1, seed=0)
    counts = []
    for variant in (named(WHOLE), named("feed-forward")):
        ppo = with_overrides(HighTrainConfig(), variant.settings or ()).ppo
        policy = FastRecurrentPolicy(
            task.observation_space, task.action_space, lambda _: 0.0,
            lstm_hidden_size=ppo.lstm, encoder=ppo.encoder,
            net_arch={"pi": list(ppo.actor), "vf": list(ppo.critic)},
        )  # fmt: skip
        of_learning = (p for name, p in policy.named_parameters() if "bias_hh" not in name)
        counts.append(sum(p.numel() for p in of_learning))
    task.close()
    assert counts[0] == 74_509 + 73_729 + NUM_ACTIONS
    assert counts[1] == 74_542 + 73_762 + NUM_ACTIONS


# ------------------------------------------------------------------ the table


TILES = list(itertools.product(("rough", "gap"), (6,), range(4)))


def result(good: str, **facts: float) -> Result:
    """A trial's result; ``good`` has a 1 for each tile whose goal was reached, else 0."""
    return Result(facts, np.array([mark == "1" for mark in good]))


def test_rows_are_over_tiles_and_seeds_and_pairs_have_the_same_seed() -> None:
    full, trot, gp = named(WHOLE), named("trot"), named("gp")
    trials = plan([full, trot, named("semantic"), gp], [1, 2])
    assert [trial.name for trial in trials] == [
        "full-1", "trot-1", "semantic-1", "gp", "full-2", "trot-2", "semantic-2"
    ]  # fmt: skip
    evaluated = {"evaluate_seconds": 90.0}
    facts = evaluated | {"steps": 1000, "train_seconds": 1800, "simulated_hours": 0.5}
    found: dict[Trial, Found] = {
        Trial(full, 1): result("11111100", **facts),
        Trial(full, 2): result("11111111", **facts | {"train_seconds": 5400}),
        Trial(trot, 1): result("11110000", **facts),
        Trial(trot, 2): "3 faults of workers",
        Trial(gp, None): result("00001111", **evaluated),
    }
    table = rows(TILES, trials, found)
    whole, one, later, script = table
    assert (whole["n"], whole["reached"], whole["versus"]) == (16, 14, None)
    assert whole["families"] == {"rough": 1.0, "gap": 0.75}
    assert whole["seeds"] == {"1": 0.75, "2": 1.0}
    assert (whole["steps"], whole["train_seconds"]) == (1000, 3600)
    assert (one["n"], one["rate"]) == (8, 0.5) and one["errors"] == {"2": "3 faults of workers"}
    assert (one["versus"]["n"], one["versus"]["lost"], one["versus"]["gained"]) == (8, 2, 0)
    assert one["versus"]["difference"] == -0.25
    assert "n" not in later and later["errors"] == {}
    # The script runs once and is compared with both trainings, on the same eight tiles.
    assert (script["n"], script["versus"]["n"]) == (8, 16) and "steps" not in script
    assert (script["versus"]["lost"], script["versus"]["gained"]) == (8, 2)
    text = describe(table)
    lines = [line.split() for line in text.splitlines()]
    assert lines[0][:2] == ["variant", "n"]
    assert lines[0][-6:] == ["rough", "gap", "steps", "walked", "trained", "evaluated"]
    assert lines[1][:3] == ["full", "16", "87.5%"]
    assert lines[1][-9:] == ["100.0%", "75.0%", "0.00M", "0.5", "h", "1.00", "h", "1.5", "min"]
    assert lines[4][-4:] == ["0.0%", "100.0%", "1.5", "min"]
    assert lines[2][:6] == ["trot", "8", "50.0%", "[21.5,", "78.5]", "-25.0"]
    assert lines[3] == ["semantic", "to", "come"]
    assert text.splitlines()[-1] == "trot, seed 2: 3 faults of workers"


# ------------------------------------------------------------------ the whole command

TINY = [
    "--steps", "48", "--levels", "6", "--episodes", "1", "--workers", "1",
    "--set", "n_envs=4", "--set", "ppo.n_steps=6", "--set", "ppo.minibatches=2",
    "--set", "ppo.n_epochs=1", "--set", "imitation.steps=0", "--set", "checkpoint_seconds=1e6",
    "--set", 'env.families=["tilt"]',
]  # fmt: skip


@pytest.mark.usefixtures("in_process", "inline_workers")
def test_an_ablation_goes_on_where_it_was_and_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An ablation stopped during its first training finishes when called again.

    One of its trials cannot run. Its policy is byte for byte the one that train_high.py trains.
    """
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    out = tmp_path / "ablation"
    command = [*TINY, "--only", "full,fixed-pose,uncalibrated", "--seeds", "5", "--out", str(out)]
    asked = []

    def due(interruption: Interruption) -> bool:
        asked.append(interruption)
        if len(asked) == 2:
            interruption.reason = "a test"
        return interruption.reason is not None

    with monkeypatch.context() as patch:
        patch.setattr(Interruption, "due", due)
        assert main(command) == 0
    assert "stopped; run the same command to continue" in capsys.readouterr().out
    assert policies.load(out / "full-5" / "policy").meta["steps"] == 24
    assert [row.get("n") for row in json.loads((out / "ablation.json").read_text())["rows"]] == [
        None, None, None
    ]  # fmt: skip
    assert main(command) == 1
    missing = f"'{LOW}' has no correction to leave out"
    assert capsys.readouterr().err.splitlines()[-1] == f"tdgc.ablate: uncalibrated-5: {missing}"
    result = json.loads((out / "ablation.json").read_text())
    full, pose, uncalibrated = result["rows"]
    assert (full["n"], full["steps"], full["simulated_hours"]) == (1, 48, 0.0)
    assert (pose["n"], pose["versus"]["n"]) == (1, 1) and "steps" not in pose
    assert uncalibrated["errors"] == {"5": missing}
    assert result["settings"]["steps"] == 48 and (out / "ablation.png").is_file()
    # The copy has the fixed pose and the tensors of its policy.
    changed, given = policies.load(out / "fixed-pose-5" / "low"), policies.load(LOW)
    assert not changed.meta["config"]["robot"]["commanded_pose"]
    assert all((changed.tensors[n] == given.tensors[n]).all() for n in given.tensors)

    flags = ["--low", str(LOW), "--seed", "5", *TINY[:2], *TINY[6:]]
    assert train_high.main([*flags, "--out", str(tmp_path / "alone")]) == 0
    alone = (tmp_path / "alone" / "policy.safetensors").read_bytes()
    assert (out / "full-5" / "policy.safetensors").read_bytes() == alone
    # A finished trial is not run again; other settings for the same folder are refused.
    before = (out / "full-5" / "cell.json").stat().st_mtime_ns
    assert main([*command[:-2], "--only", "full", "--out", str(out)]) == 0
    assert (out / "full-5" / "cell.json").stat().st_mtime_ns == before
    assert main([*command, "--episodes", "2"]) == 2
    assert capsys.readouterr().err.endswith(
        f"tdgc.ablate: '{out}' holds an ablation with episodes 1, not 2; use another --out\n"
    )


@pytest.mark.usefixtures("in_process", "inline_workers")
def test_a_trial_that_cannot_be_trained_is_named_and_the_others_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five minibatches are more than there are robots.

    So ``full`` fails, and with it ``fixed-pose``, which needs it; ``gp`` needs no training.
    """
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    flags = [*TINY, "--set", "ppo.minibatches=5", "--only", "full,fixed-pose,gp"]
    assert main([*flags, "--out", str(tmp_path)]) == 1
    table = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert table[0]["errors"] == {"42": "'ppo.minibatches' must be at most the 4 robots, not 5"}
    assert table[1]["errors"] == {"42": "it needs 'full' with seed 42, which is missing"}
    assert (table[2]["n"], table[2]["errors"]) == (1, {})
    assert capsys.readouterr().err.count("tdgc.ablate: ") == 2


def test_a_signal_after_the_last_update_stops_the_ablation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training ends all the same; its evaluation waits for the next call."""

    def train(flags: list[str]) -> int:
        low = policies.load(LOW)
        policies.save_copy(tmp_path / "full-7" / "policy", low, {**low.meta, "steps": 48})
        (tmp_path / "full-7" / "config.json").write_text('{"steps": 48}')
        Interruption(None)
        os.kill(os.getpid(), signal.SIGTERM)
        return 0

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(train_high, "main", train)
    monkeypatch.setattr(evaluate, "main", None)
    runner = Runner(tmp_path, LOW, False, (), 48, "6", 1, 1, None)
    with pytest.raises(StoppedError):
        runner.run(Trial(named("full"), 7))
    assert signal.getsignal(signal.SIGTERM) == before


EPISODES = "evaluation/episodes.csv"


def finish(folder: Path) -> None:
    """Write the files of a trial that is done, on the only tile of ``TINY``."""
    (folder / "evaluation").mkdir(parents=True)
    facts = {"evaluate_seconds": 1.0, "steps": 48, "train_seconds": 2, "simulated_hours": 0.0}
    (folder / "cell.json").write_text(json.dumps(facts))
    (folder / EPISODES).write_text("family,level,episode,outcome\ntilt,6,0,reached\n")


@pytest.mark.parametrize("script", ["teacher", "cues"])
@pytest.mark.parametrize(("trained", "taught"), [(False, False), (True, True), (True, False)])
def test_scripts_lead_as_the_teacher_taught_the_full_hierarchy(
    script: str, trained: bool, taught: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They read from the high policy of ``full`` how to command the low policy, unless that was
    trained without a teacher."""
    asked: list[object] = []

    def evaluated(main: object, flags: list[object]) -> None:
        asked.extend(flags)
        shutil.copytree(tmp_path / "of-another" / "evaluation", tmp_path / script / "evaluation")

    finish(tmp_path / "of-another")
    if trained:
        finish(tmp_path / "full-7")
        low = policies.load(LOW)
        meta = low.meta | ({"teacher": {}} if taught else {})
        policies.save_copy(tmp_path / "full-7" / "policy", low, meta)
    monkeypatch.setattr(trials, "call", evaluated)
    runner = Runner(tmp_path, LOW, False, ('env.families=["tilt"]',), None, "6", 1, 1, None)
    assert runner.run(Trial(named(script), None)).reached.tolist() == [True]
    assert asked[asked.index("--policies") + 1] == script
    assert ("--high" in asked) == taught
    if taught:
        assert asked[asked.index("--high") + 1] == tmp_path / "full-7" / "policy"


def test_the_policy_right_after_imitation_is_that_of_the_full_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def evaluated(main: object, flags: list[object]) -> None:
        asked.extend(flags)
        shutil.copytree(tmp_path / "full-7" / "evaluation", tmp_path / "imitation-7" / "evaluation")

    finish(tmp_path / "full-7")
    monkeypatch.setattr(trials, "call", evaluated)
    runner = Runner(tmp_path, LOW, False, ('env.families=["tilt"]',), None, "6", 1, 1, None)
    assert runner.run(Trial(named("imitation"), 7)).reached.tolist() == [True]
    assert asked[asked.index("--high") + 1] == tmp_path / "full-7" / "imitation"
    assert "imitation" not in [variant.name for variant in variants(alone=True)]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cell.json", "{", "{0}: not a JSON file"),
        ("cell.json", "{}", "{0}: 'evaluate_seconds' must be a number, not None"),
        (EPISODES, None, "[Errno 2] No such file or directory: '{0}'"),
        (EPISODES, "family\ntilt\n", "{0}: damaged, or not of an evaluation"),
        (EPISODES, "family,level,episode\n", "{0}: no outcome of episode 0 on tilt, level 6"),
        (
            EPISODES,
            "family,level,episode,outcome\ntilt,6,0,rea",
            "{0}: no outcome of episode 0 on ",
        ),
        ("config.json", "[]", "{0}: 'steps' must be a number, not None"),
        ("policy.json", "{", "{0}: not JSON ("),
    ],
)
def test_a_damaged_trial_is_named_and_the_others_are_kept(
    file: str, text: str | None, message: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Both trials are done, except in the last two cases: those files are read after training."""
    for name in ("full-42", "trot-42"):
        finish(tmp_path / name)
    path = tmp_path / "trot-42" / file
    if file in ("config.json", "policy.json"):
        monkeypatch.setattr(train_high, "main", lambda flags: 0)
        (path.parent / "cell.json").unlink()
        (path.parent / "checkpoints" / "step-48").mkdir(parents=True)
        (path.parent / "config.json").write_text('{"steps": 48}')
    if text is None:
        path.unlink()
    else:
        path.write_text(text)
    assert main([*TINY, "--only", "full,trot", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"tdgc.ablate: trot-42: {message.format(path)}")
    assert said.count("\n") == 1
    full, trot = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert (full["n"], full["rate"], full["errors"]) == (1, 1.0, {})
    assert "n" not in trot and trot["errors"]["42"].startswith(message.format(path))


def test_a_report_has_all_that_is_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Later trials also while an earlier one is missing, and those that are not asked for.

    The same folder on other tiles of a map is refused.
    """
    for name in ("full-42", "trot-42", "trot-7", "hardest-7", "gp", "unknown-42"):
        finish(tmp_path / name)
    asked = ["--only", "semantic,trot", "--time-limit", "0", "--out", str(tmp_path)]
    assert main([*TINY, *asked]) == 0
    table = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert [row["name"] for row in table] == ["full", "semantic", "trot", "hardest", "gp"]
    full, semantic, trot, hardest, gp = table
    assert (full["n"], trot["n"], trot["versus"]["n"], hardest["versus"], gp["n"]) == (
        1, 2, 1, None, 1
    )  # fmt: skip
    assert "n" not in semantic
    settings = json.loads((tmp_path / "settings.json").read_text())
    (tmp_path / "settings.json").write_text(json.dumps(settings | {"maps": {"hills.npy": 7}}))
    capsys.readouterr()
    assert main([*TINY, *asked]) == 2
    assert "holds an ablation with maps {'hills.npy': 7}, not {}" in capsys.readouterr().err


def test_without_a_correction_the_uncalibrated_variants_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [variant.name for variant in without_missing(VARIANTS, LOW, ())]
    assert "uncalibrated" not in names and "gp-uncalibrated" not in names
    assert len(names) == len(VARIANTS) - 2
    assert capsys.readouterr().out == (
        f"uncalibrated and gp-uncalibrated left out: '{LOW}' has no correction\n"
    )
    low = policies.load(LOW)
    policies.save_copy(tmp_path / "low", low, low.meta, corrected(low))
    assert without_missing(VARIANTS, tmp_path / "low", ()) == list(VARIANTS)


def test_without_imitation_its_policy_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    low = policies.load(LOW)
    policies.save_copy(tmp_path / "low", low, low.meta, corrected(low))
    kept = without_missing(VARIANTS, tmp_path / "low", ("imitation.steps=0",))
    assert kept == [variant for variant in VARIANTS if variant.name != "imitation"]
    assert capsys.readouterr().out == "imitation left out: nothing is imitated\n"


def corrected(low: policies.Policy) -> Correction:
    """A correction that walks half as fast as told."""
    tensors = {
        "zero": th.zeros(15), "unit": th.ones(15), "sign": th.ones(15),
        "0.weight": -0.5 * th.eye(3, 15), "0.bias": th.zeros(3),
    }  # fmt: skip
    return Correction((15, 3), tensors)


@pytest.mark.usefixtures("in_process", "inline_workers")
def test_a_low_policy_without_its_correction(tmp_path: Path) -> None:
    low = policies.load(LOW)
    policies.save_copy(tmp_path / "low", low, low.meta, corrected(low))
    without, high = changed_pair(named("gp-uncalibrated"), tmp_path / "low", None, tmp_path / "gp")
    assert high is None
    left, commands = policies.load(without), np.full((1, 15), 0.4)
    np.testing.assert_array_equal(left.correct(commands), commands)
    assert policies.load(tmp_path / "low").correct(commands)[0, 0] < 0.4
    assert left.tensors.keys() == low.tensors.keys()


def test_time_that_is_over_stops_before_a_trial(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*TINY, "--only", "full", "--time-limit", "0", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.endswith("stopped; run the same command to continue\n")
    assert not (tmp_path / "full-42").exists()


def test_two_ablations_do_not_share_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sole_user(tmp_path):
        assert main([*TINY, "--only", "full", "--time-limit", "0", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (f"tdgc.ablate: '{tmp_path}' is in use by another process\n")


@pytest.mark.parametrize(
    ("trained", "evaluated"),
    [("gap,clutter,flat,gap,ditches", "gap"), ("ditches,clutter", "ditches,clutter")],
)
def test_ground_without_a_name_is_not_evaluated_on(trained: str, evaluated: str) -> None:
    """Families in ``UNNAMED`` are left out of the evaluation unless there are no others."""
    settings = (f"env.families={json.dumps(trained.split(','))}",)
    runner = Runner(Path(), PRETRAINED / "low", False, settings, None, "6", 1, 1, None)
    flags = runner.evaluation_flags("gp", runner.low, None)
    assert flags[flags.index("--families") + 1] == evaluated


def test_a_table_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ablation.txt").mkdir()
    limits = ["--only", "full", "--time-limit", "0"]
    assert main([*TINY, *limits, "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("tdgc.ablate: [Errno 21] Is a directory: ") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--only full,lstm", "unknown variant 'lstm'; allowed: full, feed-forward, "),
        ("--no-teacher --only no-teacher", "unknown variant 'no-teacher'; allowed: full, "),
        ("--seeds 1,two", "cannot read --seeds '1,two'; write e.g. 42,43"),
        ("--levels 6-x", "cannot read --levels '6-x'"),
        ("--episodes 0", "--episodes must be at least 1, not 0"),
        ("--set env.cue=none", "unknown configuration key 'env.cue'"),
        ('--set env.families=["sand"]', "unknown family 'sand'"),
        ("--low nowhere/low", "nowhere/low.json: no such file"),
        ("--seeds 3,-1", "'seed' must be"),
        ("--steps 0", "'steps' must be"),
        ("--time-limit nan", "--time-limit must be at least 0 s, not nan"),
        ("--set seed=7", "--set cannot change 'seed' here; use --seeds"),
        ("--set low=runs/low/policy", "--set cannot change 'low' here; use --low"),
    ],
)
def test_flags_that_cannot_be_used(
    flags: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main([*flags.split(), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("tdgc.ablate: ") and message in said and said.count("\n") == 1
    assert not out.exists()


def test_variants_are_chosen_in_the_tables_order() -> None:
    chosen = choose("gp,trot,full", VARIANTS)
    assert [variant.name for variant in chosen] == ["full", "trot", "gp"]


def test_settings_of_a_training_end_with_its_own(tmp_path: Path) -> None:
    runner = Runner(tmp_path, LOW, True, ("ppo.gait_hold=3",), None, "6", 1, 1, None)
    assert runner.training_settings(named("trot")) == ("ppo.gait_hold=3", 'env.gaits=["trot"]')
    assert runner.training_settings(named("50hz"))[-1] == "ppo.gait_hold=50"
    assert (
        Runner(tmp_path, LOW, False, (), None, "6", 1, 1, None).training_settings(named("50hz"))
        == named("50hz").settings
    )
