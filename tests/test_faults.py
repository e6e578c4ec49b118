"""Worker faults: death, hang, exception, robots that blow up, and a parent that is gone."""

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from stubs import DIE, FAR, HANG, INFINITE, NAN_EARNED, NAN_SEEN, RAISE, Fragile

from tdgc.config import LowLevelConfig, PhysicsConfig, RobotConfig
from tdgc.errors import WorkerError
from tdgc.parallel.vec import FAULT_STEPS, Fault, TaskVecEnv, worker_seed
from tdgc.parallel.worker import ProcessLink
from tdgc.sim.observation import columns
from tdgc.state import join, split
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import CRITIC_LAYOUT

SPACES = (Fragile.observation_space, Fragile.action_space)


def actions(robots: int = 4, **asked: float) -> NDArray[np.float32]:
    """Ones, except for robots with an action of their own, such as ``r2=DIE``."""
    values = np.ones((robots, 1), dtype=np.float32)
    for name, value in asked.items():
        values[int(name[1:])] = value
    return values


def step(env: TaskVecEnv, values: NDArray[np.float32]) -> Any:
    """Take a step: observations, rewards, dones and infos."""
    return env.step(values)


def drawn(seed: int, count: int) -> np.float32:
    """The number that a task with ``seed`` draws at its restart number ``count``."""
    return np.float32(np.random.default_rng(seed).uniform(size=count)[-1])


@pytest.fixture
def fragile() -> Iterator[TaskVecEnv]:
    """Four robots in two workers."""
    env = TaskVecEnv(Fragile, 4, 2, seed=3, spaces=SPACES, recover=True)
    yield env
    env.close()


# ------------------------------------------------------------------ workers


def test_the_step_of_the_last_fault_counts_for_other_robots(fragile: TaskVecEnv) -> None:
    fragile.reset()
    for _ in range(2):
        step(fragile, actions(r3=RAISE))
    with pytest.raises(WorkerError):
        step(fragile, actions(r1=0.5, r3=RAISE))
    first, broken = fragile.state_dicts()
    assert first["lengths"].tolist() == [3, 3] and first["returns"].tolist() == [3.0, 2.5]
    assert fragile.starts().tolist() == [False, False, True, True] and "episodes" not in broken


def test_episodes_that_end_with_the_last_fault_are_over(fragile: TaskVecEnv) -> None:
    """The checkpoint after it begins new ones; a robot that blows up ends those of its worker."""
    fragile.reset()
    step(fragile, actions())
    for _ in range(2):
        step(fragile, actions(r3=RAISE))
    with pytest.raises(WorkerError):
        step(fragile, actions(r1=NAN_SEEN, r3=RAISE))
    assert fragile.starts().tolist()[:2] == [True, True]
    first, _ = fragile.state_dicts()
    assert first["lengths"].tolist() == [0, 0] and first["returns"].tolist() == [0.0, 0.0]


def test_workers_that_die_or_raise_are_started_anew(fragile: TaskVecEnv) -> None:
    """Worker 1 dies, then raises; worker 0 continues undisturbed."""
    fragile.reset()
    for _ in range(5):
        step(fragile, actions())
    fragile.state_dicts()  # the last known level is 5
    reasons = {
        DIE: "worker 1 died (exit code -9)",
        RAISE: "worker 1 failed: ValueError: the ground is gone",
    }
    for restarts, (fault, reason) in enumerate(reasons.items(), start=1):
        seen, *_ = step(fragile, actions())
        obs, rewards, dones, infos = step(fragile, actions(r3=fault))
        assert dones.tolist() == [False, False, True, True]
        assert rewards.tolist() == [1.0, 1.0, 0.0, 0.0]
        for i in (2, 3):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], seen[i])
            assert infos[i]["TimeLimit.truncated"]
        # It has the last known level and random numbers from the recorded seed.
        seed = worker_seed(3, 1, restarts)
        assert obs[2:].tolist() == [[i, 5.0, 0.0, drawn(seed, 2)] for i in (0, 1)]
        assert obs[:2, 1].tolist() == obs[:2, 2].tolist() == [seen[0, 1] + 1] * 2
        mended = fragile.faults.pop()
        assert (mended.worker, mended.restarts, mended.seed) == (1, restarts, seed)
        assert str(mended) == f"{reason}; restarted with seed {seed} (restart {restarts})"
        assert ("Traceback" in mended.reason) == (fault == RAISE)
        obs, rewards, dones, _ = step(fragile, actions())
        assert not dones.any() and rewards.tolist() == [1.0] * 4
        assert obs[2:, 1].tolist() == [6.0, 6.0] and obs[2:, 2].tolist() == [1.0, 1.0]
    assert not fragile.faults
    assert [state["restarts"] for state in fragile.state_dicts()] == [0, 2]
    for _ in range(FAULT_STEPS):  # after so long, a third fault is tolerated
        step(fragile, actions())
    step(fragile, actions(r2=RAISE))
    assert [fault.restarts for fault in fragile.faults] == [3]


def test_a_worker_that_hangs_is_started_anew() -> None:
    env = TaskVecEnv(Fragile, 2, 1, seed=3, spaces=SPACES, recover=True)
    env.reset()
    seen, *_ = step(env, actions(2))
    env.timeout = 1.5
    obs, rewards, dones, infos = step(env, actions(2, r0=HANG))
    env.timeout = 300.0
    assert dones.all() and (rewards == 0.0).all() and (obs[:, 1:3] == 0.0).all()
    np.testing.assert_array_equal(infos[0]["terminal_observation"], seen[0])
    assert env.faults[0].reason == "worker 0 gave no answer for 1.5 s"
    obs, _, dones, _ = step(env, actions(2))
    assert not dones.any() and (obs[:, 2] == 1.0).all()
    env.close()


class ScarceLink(ProcessLink):
    """A worker for which there is no process where ``refused`` says so, call by call."""

    refused: ClassVar[list[bool]] = []

    def __init__(self, *arguments: Any) -> None:
        if self.refused and self.refused.pop(0):
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        super().__init__(*arguments)


@pytest.mark.parametrize("refusals", [1, 2])
def test_a_worker_that_cannot_be_started_is_one_more_fault(refusals: int) -> None:
    env = TaskVecEnv(Fragile, 2, 1, seed=3, spaces=SPACES, recover=True, link=ScarceLink)
    env.reset()
    step(env, actions(2))
    env.state_dicts()
    ScarceLink.refused = [True] * refusals
    reason = "worker 0 did not start: Resource temporarily unavailable"
    if refusals == 1:
        _, _, dones, _ = step(env, actions(2, r0=RAISE))
        assert dones.all() and [fault.restarts for fault in env.faults] == [1, 2]
        assert env.faults[1].reason == reason
        step(env, actions(2))
    else:
        with pytest.raises(WorkerError, match=f"the last one: {reason}$"):
            step(env, actions(2, r0=RAISE))
    assert [state["level"] for state in env.state_dicts()] == [2 if refusals == 1 else 1]
    env.close()


def test_faults_that_come_back_are_raised(fragile: TaskVecEnv) -> None:
    """The third fault of any workers within ``FAULT_STEPS`` is raised; states stay available."""
    fragile.reset()
    step(fragile, actions())
    fragile.state_dicts()
    step(fragile, actions(r0=RAISE))
    step(fragile, actions(r3=DIE))
    with pytest.raises(WorkerError) as caught:
        step(fragile, actions(r1=RAISE))
    message = str(caught.value)
    assert message.startswith(
        "3 faults of workers within 1000 steps; the last one: worker 0 failed:\nTraceback"
    )
    assert message.rstrip().endswith("ValueError: the ground is gone")
    assert [(f.worker, f.restarts) for f in fragile.faults] == [(0, 1), (1, 1)]
    # Worker 0 is broken, its last known level is 1; worker 1, restarted at 1, took one more step.
    assert [state["level"] for state in fragile.state_dicts()] == [1, 2]
    assert len(fragile.stats()) == 1


def test_faults_between_steps(fragile: TaskVecEnv) -> None:
    """A worker found dead at any request is replaced; a resumed run knows the restarts."""
    fragile.reset()
    obs, *_ = step(fragile, actions())
    os.kill(fragile.worker_pids[0], signal.SIGKILL)
    assert [state["level"] for state in fragile.state_dicts()] == [0, 1]
    assert [sums["restarts"] for sums in fragile.stats()] == [2.0]
    seen, rewards, dones, infos = step(fragile, actions())
    assert dones.tolist() == [True, True, False, False]
    assert rewards.tolist() == [0.0, 0.0, 1.0, 1.0]
    np.testing.assert_array_equal(infos[1]["terminal_observation"], obs[1])
    assert seen[:2, 1].tolist() == [0.0, 0.0]
    os.kill(fragile.worker_pids[1], signal.SIGKILL)
    obs = fragile.reset()
    assert obs[:, 1].tolist() == [0.0, 0.0, 1.0, 1.0] and (obs[:, 2] == 0.0).all()
    assert [(f.worker, f.restarts) for f in fragile.faults] == [(0, 1), (1, 1)]
    for _ in range(3):
        seen, *_ = step(fragile, actions())
    arrays: dict[str, Any] = {}
    states = json.loads(json.dumps(split(fragile.state_dicts(), "", arrays)))
    future = [step(fragile, actions())[0], fragile.reset(), step(fragile, actions())[0]]
    other = TaskVecEnv(Fragile, 4, 2, seed=3, spaces=SPACES)
    other.load_state_dicts(join(states, arrays))
    np.testing.assert_array_equal(other.seen(), seen)
    assert [state["restarts"] for state in other.state_dicts()] == [1, 1]
    again = [step(other, actions())[0], other.reset(), step(other, actions())[0]]
    np.testing.assert_array_equal(again, future)
    other.close()


def test_the_state_of_a_broken_worker_begins_new_episodes(fragile: TaskVecEnv) -> None:
    """Its robots lose their episodes; those of the other worker continue."""
    fragile.reset()
    step(fragile, actions())
    fragile.state_dicts()
    seen, *_ = step(fragile, actions())
    os.kill(fragile.worker_pids[1], signal.SIGKILL)
    fragile.forget()  # the dead worker does not answer
    states = fragile.state_dicts()
    assert [set(state) >= {"episodes", "obs", "lengths"} for state in states] == [True, False]
    other = TaskVecEnv(Fragile, 4, 2, seed=3, spaces=SPACES)
    other.load_state_dicts(states)
    assert other.starts().tolist() == [False, False, True, True]
    np.testing.assert_array_equal(other.seen()[:2], seen[:2])
    assert other.seen()[2:, 1:3].tolist() == [[1.0, 0.0]] * 2  # the last known level
    other.forget()
    assert [sums["forgot"] for sums in other.stats()] == [1.0, 1.0]
    other.close()


# ------------------------------------------------------------------ robots


LARGE, ENORMOUS = 2e4, 2e5  # rewards: ``Fragile`` rewards an action with its number


def test_robots_that_blow_up_never_reach_the_learner() -> None:
    """A robot with a huge value ends alone; a NaN or an infinity rebuilds the world."""
    env = TaskVecEnv(Fragile, 3, 1, seed=0, spaces=SPACES)
    seed, count = worker_seed(0, 0), 2
    env.reset()
    for fault in (NAN_SEEN, NAN_EARNED, INFINITE, FAR, ENORMOUS):
        seen, rewards, *_ = step(env, actions(3, r0=LARGE))
        assert rewards[0] == LARGE  # which a large weight may cause
        obs, rewards, dones, infos = step(env, actions(3, r1=fault))
        assert rewards.tolist() == [1.0, 0.0, 1.0]
        np.testing.assert_array_equal(infos[1]["terminal_observation"], seen[1])
        level, steps = seen[0, 1] + 1, seen[0, 2] + 1
        if fault in (FAR, ENORMOUS):
            assert dones.tolist() == [False, True, False]
            assert obs[:, 2].tolist() == [steps, 0.0, steps]
        else:
            count += 1
            assert dones.all() and (obs[:, 2] == 0.0).all()
            for i in (0, 2):
                assert infos[i]["terminal_observation"][:3].tolist() == [i, level, steps]
        assert all(infos[i]["TimeLimit.truncated"] for i in np.flatnonzero(dones))
        assert (obs[:, 1] == level).all() and (obs[:, 3] == drawn(seed, count)).all()
    assert [sums["blow_ups"] for sums in (*env.stats(), *env.stats())] == [5.0, 0.0]
    env.close()


class Poisoned(LowLevelTask):
    """In the eighth step, the motors of robot 1 give a NaN torque."""

    steps = 0

    def step(self, actions: Any) -> Any:
        self.steps += 1
        if self.steps == 8:
            self.locomotion.world.strength[1] = np.nan
        return super().step(actions)

    def restart(self) -> None:
        super().restart()
        self.episodes.elapsed[:] = 0  # so that no episode ends here


def make_poisoned(robots: int, seed: int, first: int = 0) -> Poisoned:
    # With the fixed pose, actions of zero mean standing still, whatever the commands.
    robot = RobotConfig(commanded_pose=False)
    return Poisoned(LowLevelConfig(robot=robot, physics=PhysicsConfig(substeps=4)), robots, seed)


def test_a_blow_up_inside_bullet() -> None:
    """A NaN in one robot leaves its neighbours without ground, even after it is reset.

    So all three start new episodes together, and stand again 24 steps later.
    """
    probe = make_poisoned(1, 0)
    env = TaskVecEnv(make_poisoned, 3, 1, 0, (probe.observation_space, probe.action_space))
    env.reset()
    still = np.zeros((3, 12), dtype=np.float32)
    ends = []
    for _ in range(32):
        obs, rewards, dones, infos = step(env, still)
        ends.append(int(dones.sum()))
        assert np.isfinite(obs).all() and np.isfinite(rewards).all()
        last = [infos[i]["terminal_observation"] for i in np.flatnonzero(dones)]
        assert np.isfinite(last).all()
    assert ends == [0] * 7 + [3] + [0] * 24
    sums = env.stats()[0]
    assert sums["blow_ups"] == 1.0 and np.isfinite(list(sums.values())).all()
    layout = (*probe.locomotion.layout, *CRITIC_LAYOUT)
    assert (np.abs(obs[:, columns(layout)["base_height"]]) < 0.5).all()  # within 5 cm
    env.close()
    probe.close()


# ------------------------------------------------------------------ what is left behind

PARENT = """
import sys, time
sys.path[:0] = {path!r}
import test_faults as t
if __name__ == "__main__":
    env = t.TaskVecEnv(t.Fragile, 2, 2, seed=0, spaces=t.SPACES, recover=True)
    env.reset()
    env.step_async(t.actions(2, r1=t.HANG))
    print("ready", flush=True)
    time.sleep({seconds})
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/shm")
@pytest.mark.parametrize("killed", [True, False])
def test_nothing_outlives_the_parent(killed: bool, tmp_path: Path) -> None:
    """An idle worker and one that hangs both end, whether the parent is killed or just ends.

    Each holds the parent's output open, so reading it to the end waits for both.
    """
    here = Path(__file__).resolve()
    path, seconds = [str(here.parent), str(here.parents[1])], 1e6 if killed else 0.0
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(path=path, seconds=seconds), encoding="utf-8")
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None and parent.stdout.readline() == "ready\n"
    if killed:
        parent.kill()
    rest, _ = parent.communicate(timeout=300.0)
    assert rest == "" and parent.returncode == (-signal.SIGKILL if killed else 0)
    assert not list(Path("/dev/shm").glob(f"*-{parent.pid}-*"))


def test_a_fault_in_one_line() -> None:
    fault = Fault(1, "worker 1 failed:\nTraceback ...\nKeyError: 'x'\n", 2, 9)
    assert str(fault) == "worker 1 failed: KeyError: 'x'; restarted with seed 9 (restart 2)"
