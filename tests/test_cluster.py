"""Workers on several machines: a Ray cluster of three nodes, all on this machine."""

import json
import os
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from stubs import HANG, RAISE, Fragile, die, double
from test_faults import SPACES, actions, drawn, step
from test_training import TINY, at_calls, final

import evaluate
import tdgc
import train_high
import train_low
from tdgc import bench
from tdgc.errors import WorkerError
from tdgc.learn.run import Interruption
from tdgc.parallel import cluster
from tdgc.parallel.cluster import ActorLink, ClusterError, connect
from tdgc.parallel.vec import TaskVecEnv, worker_seed

TESTS = Path(__file__).resolve().parent

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="/proc"),
    pytest.mark.usefixtures("signals"),
]


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A Ray cluster: this process's node, which simulates nothing, and two with two CPUs each.

    The nodes run in an empty folder, where no relative path resolves.
    """
    patch = pytest.MonkeyPatch()
    patch.setenv("PYTHONPATH", str(TESTS))  # so that workers can import the tests' tasks
    patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    patch.setenv("RAY_worker_niceness", "0")  # otherwise other work would starve the nodes
    patch.delenv("RAY_ADDRESS", raising=False)
    with patch.context() as elsewhere:
        elsewhere.chdir(tmp_path_factory.mktemp("elsewhere"))
        made = Cluster(True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        for _ in range(2):
            made.add_node(num_cpus=2, wait=False)
        made.wait_for_nodes()
    yield made
    ray.shutdown()
    made.shutdown()
    patch.undo()


@pytest.fixture
def joined(nodes: Cluster) -> Cluster:
    """The cluster with two nodes that simulate, joined by this process."""
    while len(nodes.worker_nodes) < 2:
        nodes.add_node(num_cpus=2)
    while connect("auto") != 4:  # lost nodes still count for some seconds
        time.sleep(0.1)
    return nodes


def raylet(node: Any) -> int:
    """Process id of a node's raylet, the parent of all its workers."""
    (info,) = node.all_processes["raylet"]
    return int(info.process.pid)


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def children(pid: int) -> dict[int, str]:
    """The children of a process: process id -> command line."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return {int(p): Path(f"/proc/{p}/cmdline").read_text().strip("\0") for p in found}


def lose(nodes: Cluster, node: Any) -> None:
    """Kill all processes of a node at once, as when its power fails."""
    workers = children(raylet(node))
    nodes.remove_node(node, allow_graceful=False)
    for pid in workers:
        if runs(pid):
            os.kill(pid, signal.SIGKILL)


def runs(pid: int) -> bool:
    """Whether a process exists and is not a zombie, which has ended but was not yet reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until_gone(pids: list[int]) -> None:
    while any(runs(pid) for pid in pids):
        time.sleep(0.05)


# ------------------------------------------------------------------ joining


def test_no_cluster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A dead cluster, an unusable address and a missing Ray give one line; nothing is written."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        gone = f"127.0.0.1:{server.getsockname()[1]}"
    monkeypatch.setenv("RAY_ADDRESS", gone)
    allowed = (
        "no cluster of Ray answers; allowed: host:port, or auto for the one that RAY_ADDRESS names "
        "or that runs on this machine\n"
    )
    out = tmp_path / "out"
    for script, main in (("train_low", train_low.main), ("evaluate", evaluate.main)):
        for address in ("auto", gone, "ray://localhost:1", "here"):
            assert main(["--cluster", address, "--out", str(out)]) == 2
            assert capsys.readouterr().err == f"{script}.py: --cluster {address}: {allowed}"
    monkeypatch.setitem(sys.modules, "ray", None)
    assert train_high.main(["--cluster", "auto", "--out", str(out)]) == 2
    assert capsys.readouterr().err == (
        "train_high.py: --cluster needs ray: install the extra 'cluster', "
        "pip install -c constraints.txt -e '.[cluster]'\n"
    )
    assert not out.exists()


def test_a_node_with_other_code_is_refused(
    nodes: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed robot, a missing module and a changed one are named; an exact copy may join."""
    for folder in ("tdgc", "urdf"):
        shutil.copytree(
            Path(tdgc.__path__[0]).parent / folder,
            tmp_path / folder,
            ignore=shutil.ignore_patterns("__pycache__", "pretrained"),
        )
    monkeypatch.chdir(tmp_path.parent)  # Ray's workers look in this process's folder first
    other = nodes.add_node(num_cpus=1, env_vars={"PYTHONPATH": str(tmp_path)})
    gaits, robot = tmp_path / "tdgc/sim/gaits.py", tmp_path / "urdf/quadruped.urdf"

    def refused(files: str) -> None:
        with pytest.raises(
            ClusterError, match=rf"^node [0-9.]+ differs from this machine in {files}$"
        ):
            connect("auto")
        assert not ray.is_initialized()

    try:
        same = robot.read_text(encoding="utf-8")
        robot.write_text(same.replace("mass value", "mass  value", 1), encoding="utf-8")
        refused("urdf/quadruped.urdf")
        kept = gaits.read_text(encoding="utf-8")
        gaits.unlink()
        refused("tdgc/sim/gaits.py and 1 more")
        robot.write_text(same, encoding="utf-8")
        gaits.write_text(kept + "\n", encoding="utf-8")
        refused("tdgc/sim/gaits.py")
        gaits.write_text(kept, encoding="utf-8")
        connect("auto")
    finally:
        ray.shutdown()
        nodes.remove_node(other)


# ------------------------------------------------------------------ training


def test_a_run_in_a_cluster_is_the_run_on_this_machine(
    joined: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both end alike, bit for bit, on the plane and on tiles.

    The run in the cluster is stopped in the middle of episodes and resumed.
    """
    here, there = tmp_path / "here", tmp_path / "there"
    assert train_low.main([*TINY, "--out", str(here)]) == 0

    def stop(call: int, interruption: Interruption) -> None:
        if call == 2:
            interruption.reason = "the test"

    with monkeypatch.context() as patch:
        at_calls(patch, stop)
        assert train_low.main([*TINY, "--out", str(there), "--cluster", "auto"]) == 0
    assert train_low.main(["--resume", "--out", str(there), "--cluster", "auto"]) == 0
    assert final(there) == final(here)


def test_the_low_level_is_sent_along(joined: Cluster, tmp_path: Path) -> None:
    """Its relative path does not resolve on the nodes; the run equals one on this machine."""
    arguments = [
        "--n-envs", "2", "--workers", "1", "--steps", "8", "--set", "ppo.n_steps=4",
        "--set", "ppo.minibatches=1", "--set", "ppo.n_epochs=1", "--set", "imitation.steps=0",
        "--low", os.path.relpath(tdgc.__path__[0] + "/pretrained/low"),
    ]  # fmt: skip
    here, there = tmp_path / "here", tmp_path / "there"
    assert train_high.main([*arguments, "--out", str(here)]) == 0
    assert train_high.main([*arguments, "--out", str(there), "--cluster", "auto"]) == 0
    assert final(there) == final(here)


def test_more_workers_than_cpus(
    joined: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_low.main(["--workers", "5", "--out", str(tmp_path), "--cluster", "auto"]) == 2
    expected = "train_low.py: the cluster's 4 CPUs are too few for 5 workers\n"
    assert capsys.readouterr().err == expected


@pytest.fixture
def fragile(joined: Cluster) -> Iterator[TaskVecEnv]:
    """Eight robots in four workers, two workers on each node."""
    env = TaskVecEnv(Fragile, 8, 4, seed=3, spaces=SPACES, recover=True, link=ActorLink)
    yield env
    env.close()


def test_workers_that_are_lost_are_started_elsewhere(joined: Cluster, fragile: TaskVecEnv) -> None:
    """Two workers lost with their node count as one fault; the third fault is raised."""
    env = fragile
    env.reset()
    first = env.worker_pids
    for pid in first:
        os.kill(pid, signal.SIGINT)  # as Ctrl-C in a terminal does to all processes
    for _ in range(5):
        step(env, actions(8))
    env.state_dicts()  # the last known level is 5
    seen, *_ = step(env, actions(8))
    node = next(n for n in joined.worker_nodes if raylet(n) == parent(first[3]))
    lost = [k for k, pid in enumerate(first) if parent(pid) == raylet(node)]
    assert len(lost) == 2
    env.step_async(actions(8, **{f"r{2 * k}": HANG for k in lost}))
    joined.add_node(num_cpus=2)
    lose(joined, node)
    obs, rewards, dones, infos = env.step_wait()
    for k in range(4):
        mine = slice(2 * k, 2 * k + 2)
        if k not in lost:
            assert rewards[mine].tolist() == [1.0, 1.0] and not dones[mine].any()
            assert obs[mine, 1].tolist() == [7.0, 7.0]
            continue
        assert rewards[mine].tolist() == [0.0, 0.0] and dones[mine].all()
        level, seed = 5.0, worker_seed(3, k, 1)
        assert obs[mine].tolist() == [[i, level, 0.0, drawn(seed, 2)] for i in (0, 1)]
        for i in (2 * k, 2 * k + 1):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], seen[i])
    assert [(f.worker, f.restarts) for f in env.faults] == [(k, 1) for k in lost]
    for fault in env.faults:
        pattern = rf"worker {fault.worker} was lost with process {first[fault.worker]} on "
        assert fault.reason.startswith(pattern)
    raylets = {raylet(n) for n in joined.worker_nodes}
    assert {parent(pid) for pid in env.worker_pids} <= raylets

    step(env, actions(8, r0=RAISE))
    assert str(env.faults[-1]).startswith(
        "worker 0 failed: ValueError: the ground is gone; restarted"
    )
    assert "in step" in env.faults[-1].reason and "\x1b" not in env.faults[-1].reason
    obs, _, dones, _ = step(env, actions(8))
    assert not dones.any() and obs[:2, 2].tolist() == [1.0, 1.0]
    env.timeout = 2.0
    with pytest.raises(WorkerError, match=r"the last one: worker 1 gave no answer for 2 s$"):
        step(env, actions(8, r2=HANG))
    last = env.worker_pids
    env.close()
    wait_until_gone([*first, *last])


def test_bench_compares_the_cluster_with_this_machine(
    joined: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--cluster", "auto", "--robots", "4", "--seconds", "0.2", "--out", str(tmp_path)]
    assert bench.main([*flags, "--workers", "2"]) == 0
    result = json.loads((tmp_path / "cluster.json").read_text())
    assert (result["robots"], result["workers"]) == (4, 2)
    here, there = result["machine"], result["cluster"]
    for place in (here, there):
        assert place["steps_per_s"] == pytest.approx(4000.0 / place["ms_per_step"])
    assert result["overhead"] == pytest.approx(here["steps_per_s"] / there["steps_per_s"] - 1.0)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[:3]] == [
        "place", "machine", "cluster"
    ]  # fmt: skip
    assert bench.main([*flags, "--robots", "9", "--workers", "5"]) == 2
    expected = "tdgc.bench: the cluster's 4 CPUs are too few for 5 workers\n"
    assert capsys.readouterr().err == expected


# ------------------------------------------------------------------ evaluation


def test_jobs_are_done_in_order_and_fail_as_they_do_here(
    joined: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(cluster.run_jobs(double, range(6), 2)) == [0, 2, 4, 6, 8, 10]
    with pytest.raises(ValueError, match=r"^a negative number$") as refused:  # without a traceback
        list(cluster.run_jobs(double, [1, -1], 2))
    assert refused.type is ValueError
    monkeypatch.setattr(cluster, "_RERUNS", 1)
    with pytest.raises(WorkerError, match=r"^a job was lost 2 times \(WorkerCrashedError\)$"):
        list(cluster.run_jobs(die, [0], 1))


@pytest.mark.usefixtures("in_process")
def test_an_evaluation_that_loses_a_node_gives_the_same_table(
    joined: Cluster, tmp_path: Path
) -> None:
    """Its result files and traces equal those of a run on this machine, byte for byte."""
    flags = [
        "--policies", "gp", "--families", "gap", "--levels", "8,9,10", "--episodes", "2",
        "--trace", "all",
    ]  # fmt: skip
    here, there = tmp_path / "here", tmp_path / "there"
    assert evaluate.main([*flags, "--workers", "1", "--out", str(here)]) == 0
    hit: list[int] = []

    def lose_while_it_works() -> None:
        while not hit:
            time.sleep(0.02)
            for node in joined.worker_nodes:
                hit[:] = [p for p, name in children(raylet(node)).items() if name == "ray::_run"]
                if hit:
                    return lose(joined, node)

    thread = threading.Thread(target=lose_while_it_works)
    thread.start()
    assert evaluate.main([*flags, "--cluster", "auto", "--out", str(there)]) == 0
    thread.join()
    assert hit
    wait_until_gone(hit)
    names = sorted(str(path.relative_to(here)) for path in here.rglob("*.parquet"))
    assert len(names) == 6
    for name in ("episodes.csv", "summary.json", "trajectories.npz", "diagnosis.csv", *names):
        assert (there / name).read_bytes() == (here / name).read_bytes(), name
