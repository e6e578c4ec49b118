"""Worker processes: they compute what the tasks compute, and how they fail."""

import contextlib
import functools
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stubs import Counter, make_counter, make_failing

from tdgc.config import LowLevelConfig, PhysicsConfig
from tdgc.errors import WorkerError
from tdgc.parallel import worker
from tdgc.parallel.vec import TaskVecEnv, worker_seed
from tdgc.parallel.worker import ProcessLink
from tdgc.state import split
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import low_spaces

CONFIG = LowLevelConfig(episode_seconds=0.5, physics=PhysicsConfig(substeps=4))


make_robots = functools.partial(LowLevelTask, CONFIG)

ROBOT_SPACES = low_spaces(CONFIG)
SPACES = (Counter.observation_space, Counter.action_space)


@pytest.fixture(scope="module")
def counters() -> Iterator[TaskVecEnv]:
    """Five robots in two workers, two in the first and three in the second."""
    env = TaskVecEnv(make_counter, 5, 2, seed=3, spaces=SPACES)
    yield env
    env.close()


def test_workers_compute_what_the_tasks_do() -> None:
    """Two workers with two robots each agree bit for bit, also where episodes end."""
    tasks = [make_robots(2, worker_seed(7, k)) for k in range(2)]
    env = TaskVecEnv(make_robots, 4, 2, seed=7, spaces=ROBOT_SPACES)
    observation: Any = env.reset()
    for task in tasks:
        task.restart()
    np.testing.assert_array_equal(observation, np.concatenate([t.observe() for t in tasks]))
    rng, ends = np.random.default_rng(0), 0
    for _ in range(40):
        actions = rng.normal(size=(4, 12)).astype(np.float32)
        observation, rewards, dones, infos = env.step(actions)
        for k, task in enumerate(tasks):
            mine = slice(2 * k, 2 * k + 2)
            reward, terminated, truncated = task.step(actions[mine])
            last = task.observe()
            done = terminated | truncated
            expected = last.copy()
            if done.any():
                task.reset(np.flatnonzero(done))
                expected[done] = task.observe()[done]
            np.testing.assert_array_equal(observation[mine], expected)
            np.testing.assert_array_equal(rewards[mine], reward.astype(np.float32))
            np.testing.assert_array_equal(dones[mine], done)
            for i in np.flatnonzero(done):
                info = infos[2 * k + i]
                np.testing.assert_array_equal(info["terminal_observation"], last[i])
                assert info["TimeLimit.truncated"] == truncated[i]
                ends += 1
    assert ends > 2
    states = env.state_dicts()
    for state, task in zip(states, tasks, strict=True):
        arrays: tuple[dict[str, Any], dict[str, Any]] = {}, {}
        rest, expected_rest = split(state, "", arrays[0]), split(task.state_dict(), "", arrays[1])
        assert rest == {
            **expected_rest, "restarts": 0,
            **{name: {"array": f".{name}"} for name in ("obs", "returns", "lengths")},
        }  # fmt: skip
        for name, array in arrays[1].items():
            np.testing.assert_array_equal(arrays[0][name], array, err_msg=name)
        task.close()
    env.close()


def steps(env: TaskVecEnv, number: int) -> list[Any]:
    """Results of ``number`` steps, all with the same action."""
    gone = [env.step(np.full((4, 12), 0.3, np.float32)) for _ in range(number)]
    return [(o.tolist(), r.tolist(), d.tolist(), str(infos)) for o, r, d, infos in gone]


def test_other_workers_go_on_from_the_states() -> None:
    """From the middle of episodes, 20 steps give the same noisy observations, rewards and returns.

    Some of the episodes end within them.
    """
    env = TaskVecEnv(make_robots, 4, 2, seed=7, spaces=ROBOT_SPACES)
    env.reset()
    steps(env, 10)
    env.forget()
    states, seen, starts = env.state_dicts(), env.seen(), env.starts()
    future = steps(env, 20)
    env.close()
    assert sum(sum(done) for *_, done, _ in future) > 0 and "episode" in str(future)
    other = TaskVecEnv(make_robots, 4, 2, seed=7, spaces=ROBOT_SPACES)
    other.load_state_dicts(states)
    np.testing.assert_array_equal(other.seen(), seen)
    np.testing.assert_array_equal(other.starts(), starts)
    assert steps(other, 20) == future
    other.close()


def test_states_of_another_configuration_are_refused_in_one_line() -> None:
    """The error comes from a worker and names what differs."""
    env = TaskVecEnv(make_robots, 4, 2, seed=7, spaces=ROBOT_SPACES)
    states = env.state_dicts()
    states[1]["obs"] = states[1]["obs"][:, :-1]
    with pytest.raises(ValueError, match=r"^the state does not fit the configuration: .*shape"):
        env.load_state_dicts(states)
    env.close()


def test_ends_of_episodes(counters: TaskVecEnv) -> None:
    """Robots 0, 1 and 0, 1, 2 of the two workers end after 2, 3 and 2, 3, 4 steps."""
    first = counters.reset()
    assert first.tolist() == [[i, 0.0, 0.0] for i in (0, 1, 0, 1, 2)]
    assert first.dtype == np.float32
    actions = np.arange(10, dtype=np.float32).reshape(5, 2) / 10
    sums = actions.sum(axis=1)
    observation: Any
    observation, rewards, dones, infos = counters.step(actions)
    np.testing.assert_allclose(rewards, sums, rtol=1e-6)
    assert not dones.any() and infos == [{}] * 5
    assert observation[:, 1].tolist() == [1.0] * 5
    kept = observation.copy()
    observation, _, dones, infos = counters.step(actions)
    assert dones.tolist() == [True, False, True, False, False]
    assert observation[:, 1].tolist() == [0.0, 2.0, 0.0, 2.0, 2.0]
    for i in (0, 2):
        assert infos[i]["terminal_observation"].tolist() == [0.0, 2.0, pytest.approx(sums[i])]
        assert infos[i]["TimeLimit.truncated"] is False
        assert infos[i]["episode"] == {"r": pytest.approx(2 * sums[i]), "l": 2}
    assert infos[1] == infos[3] == infos[4] == {}
    _, _, dones, infos = counters.step(actions)
    assert dones.tolist() == [False, True, False, True, False]
    assert infos[1]["TimeLimit.truncated"] is True and infos[1]["episode"]["l"] == 3
    _, _, dones, infos = counters.step(2 * actions)
    assert dones.tolist() == [True, False, True, False, True]
    assert infos[4]["TimeLimit.truncated"] is False
    assert infos[4]["episode"] == {"r": pytest.approx(5 * sums[4]), "l": 4}
    assert infos[0]["episode"]["r"] == pytest.approx(3 * sums[0])
    # Results are copies, which later steps do not change.
    assert (kept[:, 1] == 1.0).all()
    assert infos[4]["terminal_observation"][1] == 4.0


def test_reset_begins_all_returns_anew(counters: TaskVecEnv) -> None:
    counters.reset()
    counters.step(np.ones((5, 2), dtype=np.float32))
    counters.reset()
    counters.step(np.zeros((5, 2), dtype=np.float32))
    _, _, _, infos = counters.step(np.zeros((5, 2), dtype=np.float32))
    assert infos[0]["episode"] == {"r": 0.0, "l": 2}


def test_statistics_and_states_of_each_worker(counters: TaskVecEnv) -> None:
    stats = counters.stats()
    assert [s["robots"] for s in stats] == [2.0, 3.0]
    assert all(10.0 < s["memory_mb"] < 120.0 for s in stats)  # with PyTorch it would be 174
    states = counters.state_dicts()
    assert [s["seed"] for s in states] == [worker_seed(3, 0), worker_seed(3, 1)]
    assert [s["restarts"] for s in states] == [0, 0]
    counters.step(np.ones((5, 2), dtype=np.float32))
    counters.load_state_dicts([{"worlds": 50}, {"worlds": 60}])  # as in old checkpoints
    assert [s["worlds"] for s in counters.stats()] == [51.0, 61.0]
    assert counters.starts().all() and (counters.seen()[:, 1:] == 0.0).all()
    with pytest.raises(ValueError, match=r"^states of 1 workers do not fit 2$"):
        counters.load_state_dicts(states[:1])
    with pytest.raises(ValueError, match=r"^a state of 3 robots does not fit 2$"):
        counters.load_state_dicts(states[::-1])


SCRIPT = """
import functools
from pathlib import Path
import torch
from tdgc.config import LowLevelConfig
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import low_spaces
from tdgc.parallel.vec import TaskVecEnv

class Own(LowLevelTask):
    pass

if __name__ == "__main__":
    spaces = low_spaces(LowLevelConfig())
    for task in (LowLevelTask, Own):
        env = TaskVecEnv(functools.partial(task, LowLevelConfig()), 1, 1, 0, spaces)
        print("libtorch" in Path(f"/proc/{env.worker_pids[0]}/maps").read_text())
        env.close()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_workers_have_no_torch(tmp_path: Path) -> None:
    """Workers of the low policy do not import PyTorch, nor a script unless it defines the task."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    result = subprocess.run([sys.executable, script], env=environment, capture_output=True)
    assert result.stdout.split()[-2:] == [b"False", b"True"], result.stderr.decode()


def test_what_a_batched_world_cannot_answer(counters: TaskVecEnv) -> None:
    assert counters.num_envs == 5
    assert counters.get_attr("num_envs", [0, 3]) == [5, 5]
    assert counters.env_is_wrapped(gym.Wrapper) == [False] * 5
    with pytest.raises(NotImplementedError):
        counters.set_attr("x", 1)
    with pytest.raises(NotImplementedError):
        counters.env_method("reset")


def test_a_terminals_interrupt_is_the_parents_to_answer(counters: TaskVecEnv) -> None:
    for pid in counters.worker_pids:
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    assert counters.reset().shape == (5, 3)
    assert set(counters.worker_pids) <= {p.pid for p in multiprocessing.active_children()}


class InterruptedLink(ProcessLink):
    """A worker that gets a terminal's signals while it still imports its modules."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        os.kill(self.pid, signal.SIGINT)
        os.kill(self.pid, signal.SIGTERM)


def test_signals_to_workers_that_start_are_the_parents_to_answer() -> None:
    env = TaskVecEnv(make_counter, 2, 1, seed=3, spaces=SPACES, link=InterruptedLink)
    assert env.reset().shape == (2, 3)
    env.close()


@pytest.mark.usefixtures("signals")
def test_an_interrupt_while_a_worker_starts_leaves_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is held back until the worker has started, which would then wait for its parent."""
    # Python installs it itself, unless it was started where the shell ignores SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    @contextlib.contextmanager
    def interrupted(needed: Any) -> Iterator[None]:
        yield
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(worker, "_without_script", interrupted)
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        TaskVecEnv(make_counter, 2, 1, seed=3, spaces=SPACES)
    assert set(multiprocessing.active_children()) <= before


@pytest.mark.parametrize("workers", [0, 4, -1])
def test_number_of_workers(workers: int) -> None:
    with pytest.raises(ValueError, match=f"^workers must be 1 to the 3 robots, not {workers}$"):
        TaskVecEnv(make_counter, 3, workers, seed=0, spaces=SPACES)


def test_no_time_to_answer() -> None:
    with pytest.raises(ValueError, match=r"^the workers' timeout must be above 0 s, not -1$"):
        TaskVecEnv(make_counter, 3, 1, seed=0, spaces=SPACES, timeout=-1.0)


def test_worker_seeds() -> None:
    seeds = [worker_seed(s, k, n) for s in range(20) for k in range(4) for n in range(3)]
    assert len(set(seeds)) == 240
    assert all(0 <= seed < 2**32 for seed in seeds)
    # The seed of a first start, as checkpoints of older runs expect it.
    assert worker_seed(3, 1) == worker_seed(3, 1, 0) == 457190280


def test_workers_that_raise_or_are_killed_are_named_and_close_leaves_none() -> None:
    env = TaskVecEnv(functools.partial(make_failing, "step"), 4, 2, seed=0, spaces=SPACES)
    env.reset()
    actions = np.zeros((4, 2), dtype=np.float32)
    env.step(actions)
    actions[2, 0] = 1.0  # the second worker's first robot
    with pytest.raises(WorkerError) as caught:
        env.step(actions)
    message = str(caught.value)
    assert message.startswith("worker 1 failed:\nTraceback (most recent call last):")
    assert "ValueError: the ground is gone" in message and "in step" in message
    os.kill(env.worker_pids[0], signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(WorkerError, match=r"^worker 0 died \(exit code -9\)$"):
            env.step(actions)
    with pytest.raises(WorkerError, match=r"^worker 0 died \(exit code -9\)$"):
        env.state_dicts()
    pids = set(env.worker_pids)
    env.close()
    assert not pids & {process.pid for process in multiprocessing.active_children()}
    env.close()  # closing again is harmless


def test_a_worker_that_cannot_start_takes_the_others_with_it() -> None:
    before = set(multiprocessing.active_children())
    with pytest.raises(WorkerError, match=r"(?s)^worker 0 failed:.*no robot to be had"):
        TaskVecEnv(functools.partial(make_failing, "start"), 2, 2, seed=0, spaces=SPACES)
    assert set(multiprocessing.active_children()) <= before
