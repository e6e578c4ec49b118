"""Calibration: responses are learned and inverted, and a copy of the policy learns the result."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch as th

from tdgc import calibration, policies
from tdgc.benchmark.tracking import walk_on_plane
from tdgc.calibration import ResponseModel, learn_correction, measure
from tdgc.config import CommandRanges, ConfigError, LowLevelConfig, PhysicsConfig, to_dict
from tdgc.policies import AsymmetricActorCriticPolicy, Correction, Policy
from tdgc.sim.commands import INDEX, NAMES, SIDEWAYS
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion, actor_layout
from tdgc.sim.observation import width
from tdgc.sim.robot import Array
from tdgc.tasks.low_observation import low_mirror, low_spaces
from tdgc.tasks.pairing import PRETRAINED, load_low

RANGES = CommandRanges()
MIDDLE, HALF = np.array([0.1, 0.0, 0.0]), np.array([1.1, 0.6, 1.0])  # of the velocity ranges
CONFIG = LowLevelConfig(
    families=("rough", "stair"), physics=PhysicsConfig(substeps=4, hold=1), gyro=False
)


def commands(n: int, width: float = 1.0) -> Array:
    """Random commands (n, 15) with the gaits in turn; velocities are scaled by ``width``."""
    rng = np.random.default_rng(0)
    bounds = np.array(dataclasses.astuple(RANGES))
    command = rng.uniform(bounds[:, 0], bounds[:, 1], (n, 12))
    command[:, :3] *= width
    return np.concatenate([command, gait_embedding(np.arange(n) % 4)], axis=1)


def save_low(path: Path, config: LowLevelConfig = CONFIG) -> Policy:
    """Save a small symmetric policy whose actions depend on its whole observation."""
    th.manual_seed(0)
    policy = AsymmetricActorCriticPolicy(
        *low_spaces(config), lambda _: 1e-3,
        actor_dim=width(actor_layout(config.robot, config.gyro)),
        mirror=low_mirror(config), net_arch=[32],
    )  # fmt: skip
    with th.no_grad():
        for parameter in policy.parameters():
            parameter += 0.1 * th.randn_like(parameter)
    policies.save(path, policy, {"config": to_dict(config), "steps": 7})
    return policies.load(path)


@pytest.fixture(scope="module")
def low(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    return save_low(tmp_path_factory.mktemp("calibration") / "low")


@pytest.fixture(autouse=True)
def shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_EPOCHS", 60)
    monkeypatch.setattr(calibration, "_CORRECTIONS", 800)


def learned(model: ResponseModel, seed: int = 0) -> Callable[[Array], Array]:
    """The correction learned from a response, for arrays."""
    correction = learn_correction(model, seed)
    return lambda asked: correction(th.from_numpy(asked)).numpy()


# ------------------------------------------------------------------ responses


def test_a_response_is_learned_and_put_right_for_each_gait() -> None:
    """The response undershoots by gait, loses vx with swing height and turns with vy.

    Correction leaves less than 0.35 of the error.
    """
    given = commands(1600, width=1.4)
    gain = np.array([0.9, 0.6, 0.8, 0.7])[np.arange(1600) % 4]
    reached = gain[:, None] * given[:, :3]
    reached[:, 0] -= given[:, INDEX["swing_height"]]
    reached[:, 2] += 0.5 * given[:, 1]
    rng = np.random.default_rng(1)
    model = ResponseModel(given, reached + rng.normal(0.0, 0.01, reached.shape), RANGES, seed=0)
    assert (model.error < [0.05, 0.03, 0.05]).all() and (model.error > 0.005).all()
    correct, wanted = learned(model), commands(40, width=0.7)
    assert (correct(wanted)[:, 3:] == wanted[:, 3:]).all()
    errors = []
    for asked in (wanted[:, :3], correct(wanted)[:, :3].copy()):
        made = np.array([0.9, 0.6, 0.8, 0.7] * 10)[:, None] * asked
        made[:, 0] -= wanted[:, INDEX["swing_height"]]
        made[:, 2] += 0.5 * asked[:, 1]
        errors.append(np.sqrt(np.mean((made - wanted[:, :3]) ** 2, axis=0)))
    assert (errors[0] > 0.06).all()
    assert (errors[1] < 0.35 * errors[0]).all()  # ``_PULL`` leaves a tenth or more


def test_the_error_is_that_of_all_gaits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trot does what it is told; what the other gaits do is noise, of 0.3 m/s and rad/s."""
    monkeypatch.setattr(calibration, "_EPOCHS", 2)
    given, noise = commands(400, width=1.4), np.random.default_rng(2).normal(0.0, 0.3, (400, 3))
    noise[::4] = 0.0
    model = ResponseModel(given, given[:, :3] + noise, RANGES, seed=0)
    np.testing.assert_allclose(model.error, 0.3 * np.sqrt(0.75), rtol=0.25)


def test_what_cannot_be_reached_is_not_asked_for_without_end() -> None:
    """For a robot that saturates at half of each range, corrections end at 1.2 of the ranges.

    A command that is already further out is not increased.
    """
    given = commands(800, width=1.4)
    reached = np.clip(0.7 * given[:, :3], -0.5 * HALF, 0.5 * HALF)
    model = ResponseModel(given, reached, RANGES, seed=0)
    asked = commands(40)
    correct = learned(model)
    corrected = correct(asked)
    assert (np.abs(corrected[:, :3] - MIDDLE) <= 1.2 * HALF + 1e-6).all()
    assert np.abs(corrected[:, 0]).max() > 1.1
    beyond = asked.copy()
    beyond[:, 0] = 2.0
    assert (correct(beyond)[:, 0] <= 2.0 + 1e-6).all()


def test_the_same_seed_gives_the_same_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_EPOCHS", 5)
    monkeypatch.setattr(calibration, "_CORRECTIONS", 20)
    given = commands(80)
    made = [
        learned(ResponseModel(given, 0.8 * given[:, :3], RANGES, seed), seed)(given)
        for seed in (3, 3, 4)
    ]
    assert (made[0] == made[1]).all() and (made[0] != made[2]).any()


def test_a_range_of_one_point_is_no_division_by_zero() -> None:
    ranges = dataclasses.replace(RANGES, frequency=(3.0, 3.0))
    given = commands(64)
    given[:, INDEX["frequency"]] = 3.0
    model = ResponseModel(given, given[:, :3], ranges, seed=0)
    assert np.isfinite(model(given)).all()


@pytest.fixture
def short_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_WALK_SECONDS", 1.5)
    monkeypatch.setattr(calibration, "_SETTLE_SECONDS", 0.7)


@pytest.mark.usefixtures("short_walk")
def test_robots_are_measured_in_all_gaits_beyond_the_ranges(low: Policy) -> None:
    given, reached = measure(low, 24, seed=5)
    assert len(given) == len(reached) <= 24 and reached.shape[1] == 3
    assert (np.abs(given[:, :3] - MIDDLE) <= 1.4 * HALF + 1e-9).all()
    assert (np.abs(given[:, :3] - MIDDLE) > HALF).any()
    rows = {tuple(row) for row in given[:, 12:]}
    assert rows <= {tuple(gait_embedding(g)) for g in range(len(GAITS))}
    assert len(rows) >= 2
    twice = measure(low, 24, seed=5)
    assert (twice[0] == given).all() and (twice[1] == reached).all()


def test_robots_beside_one_that_diverges_do_not_count(
    low: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    def walk(low: Policy, m: int, seconds: float, seed: int) -> Iterator[Locomotion]:
        yield from itertools.islice(walk_on_plane(low, m, seconds, seed), 3)
        raise FloatingPointError("the simulation diverged")

    monkeypatch.setattr(calibration, "walk_on_plane", walk)
    given, reached = measure(low, 5, seed=5)
    assert given.shape == (0, 15) and reached.shape == (0, 3)


def test_measured_velocities_are_those_that_robots_walk_at() -> None:
    """Within its ranges the shipped policy, which is calibrated, nearly does what it is told.

    It walks in all gaits.
    """
    given, reached = measure(policies.load(PRETRAINED / "low"), 24, seed=5)
    gaits = {tuple(row) for row in given[:, 12:]}
    assert gaits == {tuple(gait_embedding(g)) for g in range(len(GAITS))}
    inside = (np.abs(given[:, :3] - MIDDLE) <= HALF).all(axis=1)
    for axis in (0, 2):
        asked = given[inside, axis]
        assert 0.7 < asked @ reached[inside, axis] / (asked @ asked) < 1.3


# ------------------------------------------------------------------ the copy


@pytest.mark.usefixtures("short_walk")
def test_script(
    low: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(calibration, "_EPOCHS", 3)
    monkeypatch.setattr(calibration, "_CORRECTIONS", 3)
    policies.save_copy(tmp_path / "low", low, low.meta)
    arguments = ["--low", str(tmp_path / "low"), "--out", str(tmp_path / "out" / "copy")]
    small = ["--robots", "64", "--workers", "1"]
    assert calibration.main([*arguments, *small]) == 0
    said = capsys.readouterr()
    assert said.err == "" and said.out.count("\n") == 1
    assert " of 64 robots walked; the fit predicts what commands lead to within " in said.out
    copy = policies.load(tmp_path / "out" / "copy")
    assert copy.meta["config"] == low.meta["config"] and copy.meta["steps"] == 7
    assert copy.meta["calibration"]["seed"] == 42
    assert all(th.equal(tensor, copy.tensors[name]) for name, tensor in low.tensors.items())
    asked = commands(8)
    assert (copy.correct(asked)[:, :3] != asked[:, :3]).any()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--low", "{0}/none"], "none.json: no such file"),
        (["--low", "{0}/low", "--robots", "63"], "--robots must be 64 or more, not 63"),
        (["--low", "{0}/low", "--seed", "-1"], "--seed must be 0 or more, not -1"),
        (["--low", "{0}/low", "--seed", "4294967296"], "--seed must be below 2**32, not 429496"),
        (["--low", "tdgc/pretrained/high"], "high: not a low policy of this package"),
        (["--low", "tdgc/pretrained/low"], "low is calibrated already; give the policy"),
        (["--low", "{0}/low", "--workers", "0"], "--workers must be 1 or more, not 0"),
    ],
)
def test_bad_input_is_one_line(
    low: Policy, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    policies.save_copy(tmp_path / "low", low, low.meta)
    out = tmp_path / "out"
    arguments = [flag.format(tmp_path) for flag in flags]
    assert calibration.main([*arguments, "--out", str(out / "copy")]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("tdgc.calibration: ") and message in said.err
    assert said.err.count("\n") == 1 and not out.exists()


def test_the_policy_from_before_is_not_replaced(
    low: Policy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies.save_copy(tmp_path / "low", low, low.meta)
    before = (tmp_path / "low.json").read_bytes()
    given = ["--low", str(tmp_path / "low.json"), "--out", str(tmp_path / "low")]
    assert calibration.main(given) == 2
    assert capsys.readouterr().err == (
        f"tdgc.calibration: --out would replace --low, {tmp_path / 'low.json'}; give another path\n"
    )
    assert (tmp_path / "low.json").read_bytes() == before


def test_where_nothing_can_be_written_nothing_is_calibrated(
    low: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def calibrate(*args: object) -> None:
        raise AssertionError("it has begun")

    monkeypatch.setattr(calibration, "calibrate", calibrate)
    policies.save_copy(tmp_path / "low", low, low.meta)
    out = tmp_path / "low.json" / "copy"  # below a file
    assert calibration.main(["--low", str(tmp_path / "low"), "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("tdgc.calibration: ")
    assert "low.json'" in said.err and said.err.count("\n") == 1


@pytest.fixture(scope="module")
def faster(low: Policy, tmp_path_factory: pytest.TempPathFactory) -> Policy:
    """The policy with a correction of known effect: vx + 0.2 + 0.5 tanh(roll), which favours a
    side, and vy + 0.5 tanh(vy)."""
    tensors = {
        "zero": th.zeros(15), "unit": th.ones(15),
        "sign": th.tensor([-1.0 if name in SIDEWAYS else 1.0 for name in NAMES]),
        "0.weight": th.zeros(2, 15), "0.bias": th.zeros(2),
        "1.weight": th.zeros(3, 2), "1.bias": th.tensor([0.2, 0.0, 0.0]),
    }  # fmt: skip
    tensors["0.weight"][0, INDEX["vy"]] = tensors["0.weight"][1, INDEX["roll"]] = 1.0
    tensors["1.weight"][1, 0] = tensors["1.weight"][0, 1] = 0.5
    path = tmp_path_factory.mktemp("correction") / "faster"
    policies.save_copy(path, low, low.meta, Correction((15, 2, 3), tensors))
    return policies.load(path)


def test_a_correction_is_kept_and_exactly_symmetric(low: Policy, faster: Policy) -> None:
    asked = commands(8)
    given = faster.correct(asked)
    vx, vy, roll = (asked[:, INDEX[name]] for name in ("vx", "vy", "roll"))
    # What would depend on the side, half the roll in vx, is gone.
    np.testing.assert_allclose(given[:, 0], np.clip(vx + 0.2, -1.2, 1.2), atol=1e-6)
    np.testing.assert_allclose(given[:, 1], vy + 0.5 * np.tanh(vy), atol=1e-6)
    assert (given[:, 3:] == asked[:, 3:]).all() and np.ptp(roll) > 0.1
    sign = np.where(np.isin(NAMES, SIDEWAYS), -1.0, 1.0)
    assert (faster.correct(sign * asked) == sign * given).all()
    assert low.correct(asked) is asked


def test_a_corrected_policy_walks_as_it_does_at_the_corrected_commands(
    low: Policy, faster: Policy
) -> None:
    asked = commands(4, width=0.5)
    ends = []
    for policy, command in ((faster, asked), (low, faster.correct(asked))):
        for step, loco in enumerate(walk_on_plane(policy, 4, 0.4, seed=0)):
            loco.command[:] = command
            if step == 19:
                ends.append((loco.world.state.q.copy(), loco.carried_out[:, :3]))
    assert (ends[0][0] == ends[1][0]).all()
    assert (ends[0][1] == asked[:, :3]).all()  # what is traced is what was asked


def test_a_correction_that_cannot_be_used_is_refused(
    low: Policy, faster: Policy, tmp_path: Path
) -> None:
    assert faster.correction is not None
    tensors = {n.partition(".")[2]: t for n, t in faster.correction.tensors().items()}
    flat = Correction((15, 2, 3), tensors)
    flat.unit = th.zeros(15)
    policies.save_copy(tmp_path / "flat", low, low.meta, flat)
    with pytest.raises(policies.PolicyFileError, match="flat: the units of a correction must be"):
        policies.load(tmp_path / "flat")
    short = {"zero": th.zeros(4), "unit": th.ones(4), "sign": th.ones(4)}
    short |= {"0.weight": th.zeros(3, 4), "0.bias": th.zeros(3)}
    policies.save_copy(tmp_path / "short", low, low.meta, Correction((4, 3), short))
    with pytest.raises(ConfigError, match="short: its correction is not one of the 15 commands"):
        load_low(tmp_path / "short")
