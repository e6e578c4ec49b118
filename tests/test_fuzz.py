"""Fuzzing: whatever a file or flag holds is refused in one line or survives a round trip.

Every reader is given damaged, foreign and hostile input. It may raise the error that it documents,
with a message of one line, or return a value that survives being written and read again. It must
not run code from the input or write outside the given folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import pickle
import shutil
import struct
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import safetensors.torch
import torch as th
from gymnasium import spaces
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from test_drivers import save_high
from test_trace import same

from tdgc import policies
from tdgc.benchmark import trace, tuning
from tdgc.benchmark.drivers import load_high
from tdgc.benchmark.trace import COLUMNS, Trace, TraceError
from tdgc.benchmark.tuning import Tuning
from tdgc.config import (
    ConfigError,
    HighTrainConfig,
    LowTrainConfig,
    from_dict,
    to_dict,
    with_overrides,
)
from tdgc.errors import InputError
from tdgc.learn.checkpoints import Checkpoint, CheckpointError
from tdgc.learn.flags import configure
from tdgc.policies import AsymmetricActorCriticPolicy, Header, PolicyFileError
from tdgc.tasks.pairing import PRETRAINED, load_low

#: The same examples in every run.
examples = settings(deadline=None, derandomize=True, database=None, max_examples=60)
few = settings(examples, max_examples=25)

Value = TypeVar("Value")


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder for the files to read; the working directory is its parent."""
    around = tmp_path_factory.mktemp("around")
    (around / "given").mkdir()
    with contextlib.chdir(around):
        yield around / "given"


def answer(read: Callable[[], Value], *errors: type[InputError]) -> Value | None:
    """Return what ``read`` returns, or None if it refuses its input as documented."""
    try:
        return read()
    except InputError as error:
        assert type(error) in errors and str(error) and str(error).isprintable()
        return None
    finally:
        assert os.listdir() == ["given"]  # no code ran, nothing was written outside


# ------------------------------------------------------------------ input


class Bomb:
    """Unpickling one of these makes a folder in the working directory."""

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return (os.mkdir, ("boom",))


BOMB = pickle.dumps(Bomb())
CODE = (
    "__import__('os').mkdir('boom')",
    "$(mkdir boom)",
    "!!python/object/apply:os.mkdir ['boom']",
    BOMB.decode("latin-1"),
)


def test_the_bomb_is_live() -> None:
    pickle.loads(BOMB)
    os.rmdir("boom")


NUMBERS = (
    st.integers(-(2**53), 2**53)  # all exact as floats
    | st.floats()
    | st.sampled_from([10**400, -(10**400), 2**63, 2**128, 1e308, -0.0, 0.1])
)
WORDS = st.text(max_size=8) | st.sampled_from(
    [*CODE, "../boom", "a/b", "\0", "\n", "\ud800", "trot", "plane", "elu", "lstm", "F32"]
)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=6,
)
#: Places, whether to overwrite or insert, and the bytes; None cuts off the rest.
DAMAGE = st.lists(
    st.tuples(st.integers(0, 2**20), st.booleans(), st.none() | st.binary(min_size=1, max_size=4)),
    min_size=1,
    max_size=3,
)
Damage = list[tuple[int, bool, bytes | None]]


def damaged(data: bytes, damage: Damage) -> bytes:
    for place, over, new in damage:
        at = place % (len(data) + 1)
        if new is None:
            data = data[:at]
        else:
            data = data[:at] + new + data[at + len(new) * over :]
    return data


def places(tree: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys that lead to each node of a JSON tree."""
    inner = enumerate(tree) if isinstance(tree, list) else tree.items()
    for key, value in inner:
        yield (*where, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*where, key))


def changed(tree: Any, where: tuple[Any, ...], value: Any) -> Any:
    """A copy of a JSON tree with another value at one of its ``places``."""
    if not where:
        return value
    copy = dict(tree) if isinstance(tree, dict) else list(tree)
    copy[where[0]] = changed(tree[where[0]], where[1:], value)
    return copy


def at(tree: Any, where: tuple[Any, ...]) -> Any:
    for key in where:
        tree = tree[key]
    return tree


def nested(depth: int, inner: str = "1") -> str:
    return "[" * depth + inner + "]" * depth


#: About as deep as Python's recursion limit lets a reader go, and far deeper.
DEPTHS = (*range(850, 1000), 100_000)


# ------------------------------------------------------------------ configurations, assignments

CONFIGS = (LowTrainConfig(), HighTrainConfig(), Tuning())
PLACES = st.sampled_from([(c, where) for c in CONFIGS for where in places(to_dict(c))])
SETTINGS = {".".join(map(str, where)) for c in CONFIGS for where in places(to_dict(c))}


def check_config(config: Any) -> None:
    text = json.dumps(to_dict(config), allow_nan=False)
    assert from_dict(type(config), json.loads(text)) == config


@examples
@given(PLACES, VALUES)
@example((LowTrainConfig(), ("env", "robot", "kp")), 10**400)
@example((LowTrainConfig(), ("env", "commands", "vx")), [-(10**400), 0])
def test_a_configuration_with_any_value(place: Any, value: Any) -> None:
    config, where = place
    data = changed(to_dict(config), where, value)
    found = answer(lambda: from_dict(type(config), data), ConfigError)
    if found is not None:
        check_config(found)
        if not isinstance(value, dict):  # a table may leave keys out
            assert at(to_dict(found), where) == value


@examples
@given(st.dictionaries(WORDS | st.sampled_from(["env", "seed", "ppo"]), VALUES, max_size=3))
def test_a_configuration_with_any_keys(data: dict[str, Any]) -> None:
    found = answer(lambda: from_dict(LowTrainConfig, data), ConfigError)
    if found is not None:
        check_config(found)
        assert set(data) <= set(to_dict(found))


@examples
@given(PLACES, WORDS | VALUES.map(json.dumps))
@example((LowTrainConfig(), ("seed",)), "9" * 5000)
@example((LowTrainConfig(), ("seed",)), nested(100_000))
def test_any_value_of_an_assignment(place: Any, text: str) -> None:
    config, where = place
    assignment = ".".join(map(str, where)) + "=" + text
    found = answer(lambda: with_overrides(config, [assignment]), ConfigError)
    if found is not None:
        check_config(found)


@examples
@given(st.text(max_size=20) | st.builds("{}={}".format, WORDS, WORDS))
def test_any_assignment(text: str) -> None:
    # Hypothesis also draws strings from the package's source, such as assignments of presets.
    assume("=" not in text or text.partition("=")[0].strip() not in SETTINGS)
    for config in CONFIGS:
        found = answer(lambda c=config: with_overrides(c, [text]), ConfigError)
        assert found is None  # no such key


def test_values_as_deep_as_can_be_read(folder: Path) -> None:
    path = folder / "tuning.json"
    for depth in DEPTHS:
        assert (
            answer(lambda d=depth: tuning.load(None, [f"safety={nested(d)}"]), ConfigError) is None
        )
        path.write_text(f'{{"decision_rate": {nested(depth)}}}', encoding="utf-8")
        assert answer(lambda: tuning.load(path), ConfigError) is None


@examples
@given(DAMAGE, st.lists(st.text(max_size=12), max_size=1))
def test_a_damaged_tuning(folder: Path, damage: Damage, texts: list[str]) -> None:
    path = folder / "tuning.json"
    good = {
        "decoder": {"vx": {"low": -0.2, "high": 0.6}, "gaits": ["trot", "bound"]},
        "decision_rate": 5,
        "safety": {"max_tilt": 0.5},
    }
    path.write_bytes(damaged(json.dumps(good).encode(), damage))
    found = answer(lambda: tuning.load(path, texts), ConfigError)
    if found is not None:
        check_config(found)
        path.write_text(json.dumps(tuning.record(found)), encoding="utf-8")
        assert tuning.load(path) == found


@examples
@given(st.binary(max_size=20) | VALUES.map(lambda v: json.dumps(v).encode()) | DAMAGE)
def test_any_configuration_of_a_run(folder: Path, content: bytes | Damage) -> None:
    run = folder / "run"
    run.mkdir(exist_ok=True)
    good = json.dumps(to_dict(LowTrainConfig())).encode()
    data = content if isinstance(content, bytes) else damaged(good, content)
    (run / "config.json").write_bytes(data)
    flags = dict.fromkeys(("seed", "n_envs", "workers", "steps", "cluster", "init", "time_limit"))
    flags |= {"out": run, "resume": True, "assignments": [], "device": "cpu", "worker_timeout": 1.0}
    args = Namespace(**flags)
    found = answer(lambda: configure(LowTrainConfig(), args), ConfigError)
    if found is not None:
        check_config(found)


# ------------------------------------------------------------------ policies


@pytest.fixture(scope="module")
def policy(folder: Path) -> tuple[Path, bytes, bytes]:
    """A small policy's path, its JSON and its weights."""
    box = spaces.Box(-np.inf, np.inf, (4,)), spaces.Box(-1.0, 1.0, (2,))
    made = AsymmetricActorCriticPolicy(
        *box, lambda _: 0.0, actor_dim=3, net_arch={"pi": [3], "vf": [2]}
    )
    policies.save(folder / "policy", made, {"seed": 1, "config": {"kp": [0.5, None, "x"]}})
    return folder / "policy", *(
        (folder / f"policy.{kind}").read_bytes() for kind in ("json", "safetensors")
    )


def check_policy(path: Path, text: bytes, weights: bytes) -> policies.Policy | None:
    """Load a policy from these files; if it is accepted, it must be complete and finite."""
    Path(f"{path}.json").write_bytes(text)
    Path(f"{path}.safetensors").write_bytes(weights)
    found = answer(lambda: policies.load(path), PolicyFileError)
    if found is not None:
        header, checksum = Header.from_json(text.decode())
        assert Header.from_json(header.to_json(checksum)) == (header, checksum)
        assert {k: tuple(v.shape) for k, v in found.tensors.items()} == header.shapes()
        assert all(v.isfinite().all() for v in found.tensors.values())
        assert found.predict(np.ones(found.obs_dim))[0].shape == (found.action_dim,)
    return found


def summed(text: bytes, weights: bytes) -> bytes:
    """The JSON with the checksum of other weights, so that their content is checked."""
    table = json.loads(text)
    return json.dumps({**table, "sha256": hashlib.sha256(weights).hexdigest()}).encode()


@examples
@given(DAMAGE)
def test_damaged_policy_files(policy: tuple[Path, bytes, bytes], damage: Damage) -> None:
    path, text, weights = policy
    check_policy(path, damaged(text, damage), weights)
    broken = damaged(weights, damage)
    assert check_policy(path, text, broken) is None or broken == weights
    check_policy(path, summed(text, broken), broken)


@examples
@given(st.data(), VALUES)
def test_a_policy_file_with_any_value(
    policy: tuple[Path, bytes, bytes], data: st.DataObject, value: Any
) -> None:
    path, text, weights = policy
    table = json.loads(text)
    where = data.draw(st.sampled_from([(), *places(table)]))
    check_policy(path, json.dumps(changed(table, where, value)).encode(), weights)


def test_a_policy_file_as_deep_as_can_be_read(policy: tuple[Path, bytes, bytes]) -> None:
    path, text, weights = policy
    table = json.loads(text)
    for where in (("version",), ("architecture",), ("architecture", "lstm"), ("action", "low", 0)):
        marked = json.dumps(changed(table, where, "here"))
        for depth in DEPTHS:
            deep = marked.replace('"here"', nested(depth)).encode()
            assert check_policy(path, deep, weights) is None


TENSORS = st.dictionaries(
    WORDS | st.sampled_from(["log_std", "actor.0.weight", "actor.0.bias", "__metadata__"]),
    st.fixed_dictionaries(
        {
            "dtype": st.sampled_from(["F32", "F64", "BOOL", "I64", "F4", "F8_E8M0", "X"]),
            "shape": st.lists(st.sampled_from([0, 1, 2, 3, 2**32, 2**63, 2**64]), max_size=3),
            "data_offsets": st.lists(st.sampled_from([0, 4, 8, 12, 2**64 - 1]), max_size=3),
        }
    )
    | VALUES,
    max_size=3,
)


def tensor_file(table: Any, content: bytes, size: int | None) -> bytes:
    """A safetensors file with any header, whose stated length is ``size`` if given."""
    header = json.dumps(table).encode()
    return struct.pack("<Q", len(header) if size is None else size) + header + content


TENSOR_FILES = (
    st.builds(
        tensor_file,
        TENSORS,
        st.binary(max_size=24),
        st.none() | st.sampled_from([0, 1, 2**31, 2**63, 2**64 - 1]),
    )
    | st.binary(max_size=32)
    | st.just(BOMB)
)


@examples
@given(TENSOR_FILES, st.booleans())
def test_foreign_weights(policy: tuple[Path, bytes, bytes], weights: bytes, padded: bool) -> None:
    path, text, good = policy
    weights += b"\0" * len(good) * padded
    assert check_policy(path, summed(text, weights), weights) is None
    assert check_policy(path, weights, good) is None


@pytest.mark.filterwarnings("ignore:overflow encountered in exp")  # from a log_std of 3e38
@examples
@given(st.data(), st.sampled_from([np.nan, np.inf, -np.inf, 3e38]), st.sampled_from("abcd"))
def test_weights_of_other_shapes_and_numbers(
    policy: tuple[Path, bytes, bytes], data: st.DataObject, number: float, change: str
) -> None:
    path, text, weights = policy
    tensors = safetensors.torch.load(weights)
    name = data.draw(st.sampled_from(sorted(tensors)))
    tensor = tensors.pop(name)
    if change == "a":
        tensors[name] = tensor.new_full(tensor.shape, number)
    elif change == "b":
        tensors[name] = th.cat([tensor, tensor])
    elif change == "c":
        tensors[name] = tensor[None]
    broken = safetensors.torch.save(tensors)
    found = check_policy(path, summed(text, broken), broken)
    assert (found is not None) == (change == "a" and number == 3e38)


@pytest.fixture(scope="module")
def pair(folder: Path) -> dict[str, Any]:
    """Save a low and a high policy; return the contents of their JSON files."""
    for kind in ("json", "safetensors"):
        shutil.copy(f"{PRETRAINED / 'low'}.{kind}", f"{folder / 'low'}.{kind}")
    save_high(folder / "high", load_low(folder / "low"))
    return {name: json.loads((folder / f"{name}.json").read_text()) for name in ("low", "high")}


@few
@given(st.data(), VALUES)
def test_levels_with_any_meta(
    folder: Path, pair: dict[str, Any], data: st.DataObject, value: Any
) -> None:
    low = load_low(folder / "low")
    name = data.draw(st.sampled_from(["low", "high"]))
    where = data.draw(st.sampled_from(list(places(pair[name]["meta"]))))
    table = changed(pair[name], ("meta", *where), value)
    path = folder / "changed"
    shutil.copy(folder / f"{name}.safetensors", f"{path}.safetensors")
    Path(f"{path}.json").write_text(json.dumps(table), encoding="utf-8")
    if name == "low":
        loaded = answer(lambda: load_low(path), PolicyFileError, ConfigError)
    else:
        loaded = answer(lambda: load_high(path, *low), PolicyFileError, ConfigError)
    if loaded is not None:
        check_config(loaded[1])


# ------------------------------------------------------------------ checkpoints


@pytest.fixture(scope="module")
def checkpoint(folder: Path) -> tuple[Path, bytes, bytes]:
    """A checkpoint's path, its header and its tensors; an older one is beside it."""
    tensors = {"policy.a": th.arange(6.0).reshape(2, 3), "random.torch": th.tensor([1, 2, 3])}
    header = {
        "format": "tdgc-checkpoint",
        "version": 17,
        "n_updates": 3,
        "random": {"numpy": [1, 0, 0.5], "kind": "MT19937"},
        "workers": [{"epoch": 3, "position": {"array": "extra.workers.0.position"}}],
    }
    for steps in (10, 20):
        taken = Checkpoint(tensors, {**header, "num_timesteps": steps})
        path = taken.save(folder / "run" / "checkpoints")
    return path, (path / "state.json").read_bytes(), (path / "state.safetensors").read_bytes()


def check_checkpoint(path: Path, text: bytes, tensors: bytes) -> None:
    """Read a checkpoint with these files; a run must resume from it or from the one before."""
    (path / "state.json").write_bytes(text)
    (path / "state.safetensors").write_bytes(tensors)
    found = answer(lambda: Checkpoint.read(path), CheckpointError)
    told: list[str] = []
    run = path.parents[1]
    newest = answer(lambda: Checkpoint.newest(run, told.append), CheckpointError)
    assert newest is not None and all(line.isprintable() for line in told)
    if found is None:
        assert newest.steps == 10 and len(told) == 1
    else:
        assert json.dumps(newest.header) == json.dumps(found.header) and not told
        with tempfile.TemporaryDirectory(dir=run.parent) as copy:
            again = Checkpoint.read(found.save(Path(copy)))
        # Both are written again, as there is more than one way to write a tensor.
        assert safetensors.torch.save(again.tensors) == safetensors.torch.save(found.tensors)
        told_apart = ("sha256",)
        kept, written = (
            {k: v for k, v in one.header.items() if k not in told_apart} for one in (found, again)
        )
        assert json.dumps(kept) == json.dumps(written)


@examples
@given(DAMAGE)
def test_damaged_checkpoints(checkpoint: tuple[Path, bytes, bytes], damage: Damage) -> None:
    path, text, tensors = checkpoint
    check_checkpoint(path, damaged(text, damage), tensors)
    broken = damaged(tensors, damage)
    check_checkpoint(path, text, broken)
    check_checkpoint(path, summed(text, broken), broken)


@examples
@given(st.data(), VALUES)
def test_a_checkpoint_with_any_value(
    checkpoint: tuple[Path, bytes, bytes], data: st.DataObject, value: Any
) -> None:
    path, text, tensors = checkpoint
    table = json.loads(text)
    where = data.draw(st.sampled_from([(), *places(table)]))
    check_checkpoint(path, json.dumps(changed(table, where, value)).encode(), tensors)


@examples
@given(TENSOR_FILES)
def test_foreign_tensors(checkpoint: tuple[Path, bytes, bytes], tensors: bytes) -> None:
    path, text, _ = checkpoint
    check_checkpoint(path, summed(text, tensors), tensors)
    check_checkpoint(path, tensors, tensors)


def test_checkpoints_as_deep_as_can_be_read(checkpoint: tuple[Path, bytes, bytes]) -> None:
    path, text, tensors = checkpoint
    for depth in (900, 100_000):
        check_checkpoint(path, nested(depth).encode(), tensors)
        check_checkpoint(path, text.replace(b": 20", f": {nested(depth)}".encode()), tensors)


# ------------------------------------------------------------------ traces


@pytest.fixture(scope="module")
def traced(folder: Path) -> tuple[Trace, bytes]:
    """A trace of three rows and the content of its file."""
    rng = np.random.default_rng(0)
    columns: dict[str, Any] = {}
    for c in COLUMNS:
        numbers = rng.normal(size=3).astype(np.float32)
        columns[c.name] = numbers if c.unit else np.array(["trot", "pace", None], dtype=object)
    made = Trace("tdgc", "nominal", "stair", 6, 0, 5, "fell", columns)
    return made, trace.write(made, folder).read_bytes()


def check_trace(path: Path) -> Trace | None:
    found = answer(lambda: trace.read(path), TraceError)
    if found is not None:
        with tempfile.TemporaryDirectory(dir=path.parent) as copy:
            again = trace.read(trace.write(found, copy))
        assert os.listdir() == ["given"] and same(again, found)
    return found


@examples
@given(DAMAGE)
def test_damaged_traces(folder: Path, traced: tuple[Trace, bytes], damage: Damage) -> None:
    path = folder / "damaged.parquet"
    path.write_bytes(damaged(traced[1], damage))
    check_trace(path)


META = st.sampled_from(["format", "version", *(f.name for f in dataclasses.fields(Trace))])


@few
@given(st.dictionaries(META, WORDS.map(lambda w: w.encode(errors="replace")), max_size=2))
@example({"policy": b"../boom"})
@example({"policy": b"\xff"})
@example({"version": b"2\n3"})
@example({"level": b"-3", "seed": "\uff15".encode()})
@example({"level": b"9" * 5000})
def test_traces_of_any_episode(
    folder: Path, traced: tuple[Trace, bytes], meta: dict[str, bytes]
) -> None:
    path = folder / "changed.parquet"
    table = pq.read_table(folder / traced[0].file_name)
    changed_meta = table.schema.metadata | {k.encode(): v for k, v in meta.items()}
    pq.write_table(table.replace_schema_metadata(changed_meta), path)
    check_trace(path)


def test_a_type_that_brings_code_along(folder: Path, traced: tuple[Trace, bytes]) -> None:
    table = pq.read_table(folder / traced[0].file_name)
    about = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": BOMB}
    field = table.schema.field("time")
    field = field.with_metadata({**field.metadata, **about})
    path = folder / "extended.parquet"
    pq.write_table(table.set_column(0, field, table.column("time")), path)
    assert pq.read_schema(path).field("time").metadata[b"ARROW:extension:metadata"] == BOMB
    check_trace(path)


def test_names_that_are_no_text(folder: Path, traced: tuple[Trace, bytes]) -> None:
    table = pq.read_table(folder / traced[0].file_name)
    place = table.schema.get_field_index("gait")
    ends = pa.py_buffer(np.array([0, 1, 2, 3], dtype=np.int32))
    names = pa.Array.from_buffers(pa.string(), 3, [None, ends, pa.py_buffer(b"\xff\xfe\xfd")])
    path = folder / "names.parquet"
    pq.write_table(table.set_column(place, table.schema.field(place), names), path)
    assert check_trace(path) is None
