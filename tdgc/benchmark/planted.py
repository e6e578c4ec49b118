"""Faults planted in a pair of policies, to check the diagnosis and its limits.

    python -m tdgc.benchmark.planted
    python -m tdgc.benchmark.planted --low runs/low/policy --high runs/high/policy

Does the diagnosis blame the layer at fault, and do its limits fit the pair? Prints, for each fault
and family, how many failures were blamed on the right layer, and the bounds that 95 % of the
tracking errors stay below without a fault (docs/trace.md).
"""

import argparse
import functools
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.diagnosis import (
    LIMITS,
    LOOK_BACK,
    SETTLE,
    diagnose,
    free,
    settled,
    tile_under,
    tracking_errors,
)
from tdgc.benchmark.drivers import BaselineDriver, Decides, Driver, HierarchyDriver, load_high
from tdgc.benchmark.evaluation import Cell, run_cell
from tdgc.benchmark.trace import Trace, Tracer
from tdgc.config import HighLevelConfig
from tdgc.errors import script
from tdgc.policies import Policy
from tdgc.sim.commands import INDEX, VELOCITIES
from tdgc.sim.families import FAMILIES
from tdgc.sim.geometry import read_geometry
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.observation import columns
from tdgc.sim.robot import Array
from tdgc.sim.urdf import JOINTS
from tdgc.tasks.high_observation import high_layout
from tdgc.tasks.pairing import PRETRAINED, load_low

SEED = 11  # of the tiles for faults; limits are measured on others
EPISODES = 4  # per fault and family
#: Level by family: hard enough for a fault to show, easy enough that nothing else does.
LEVELS = dict.fromkeys(FAMILIES, 6) | {"rough": 4}
LIMIT_SEEDS, LIMIT_LEVELS, LIMIT_EPISODES = (1, 2), (6, 8), 5
_SHARE = 95  # per cent of the errors in successful episodes that stay below a limit
_WEAK = 0.02  # share of its strength that a weak motor has left, chosen by hand


class WeakMotor(HierarchyDriver):
    """One motor of every robot has lost most of its strength; ``joint`` is one of ``JOINTS``."""

    def __init__(self, high: Decides, config: HighLevelConfig, joint: str) -> None:
        super().__init__(high, config)
        self._joint = JOINTS.index(joint)

    def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
        super().begin(loco, goal, *told)
        strength = np.tile(loco.world.strength, (1, len(JOINTS)))
        strength[:, self._joint] = _WEAK
        loco.world.strength = strength


class SwappedBounds(HierarchyDriver):
    """The decoder's lower and upper bound of one command are swapped."""

    def __init__(self, high: Decides, config: HighLevelConfig, command: str) -> None:
        super().__init__(high, config)
        decoder, j = self._decoder, INDEX[command]
        decoder.low[j], decoder.high[j] = decoder.high[j], decoder.low[j]


class Blindfold(HierarchyDriver):
    """The high policy sees flat ground of an unknown family and a goal in a random direction."""

    def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
        angle = np.random.default_rng(0).uniform(-np.pi, np.pi, loco.num_robots)
        here = loco.world.state.position[:, :2]
        c, s = np.cos(angle), np.sin(angle)
        x, y = (goal - here).T
        turned = here + np.stack([c * x - s * y, s * x + c * y], axis=1)
        super().begin(loco, turned, "unknown")

    def _observe(self, decision: int) -> Any:
        seen = super()._observe(decision)
        self.probes = None
        probes = columns(high_layout(self.config)).get("probes")
        if probes is not None:
            seen[:, probes] = 0.0
        return seen


@dataclass(frozen=True)
class PlantedFault:
    """A fault to plant in a pair.

    Attributes:
        name: description of the fault.
        layer: the layer to blame, one of ``LAYERS``.
        plant: makes the driver with the fault from a high policy and its MDP.
    """

    name: str
    layer: str
    plant: Callable[[Decides, HighLevelConfig], HierarchyDriver]


FAULTS = (
    *(
        PlantedFault(
            f"{what} motor at {100 * _WEAK:g} % strength",
            "execution",
            functools.partial(WeakMotor, joint=joint),
        )
        for what, joint in (
            ("a hip's", "FL_hip_joint"),
            ("a thigh's", "FL_thigh_joint"),
            ("a front calf's", "FL_calf_joint"),
            ("a rear calf's", "RR_calf_joint"),
        )
    ),
    *(
        PlantedFault(
            f"bounds of {name} swapped", "decisions", functools.partial(SwappedBounds, command=name)
        )
        for name in VELOCITIES
    ),
    PlantedFault("a blindfolded high policy", "decisions", Blindfold),
)


def traced(
    driver: Driver, low: Policy, family: str, level: int, count: int, seed: int
) -> list[Trace]:
    """Run the first ``count`` episodes of a cell and return their traces."""
    tracer = Tracer(driver)
    run_cell(Cell("planted", "nominal", family, level, 0, count), low, driver, seed, [tracer])
    return tracer.traces()


def blamed(
    driver: Driver, low: Policy, family: str, level: int, count: int, hips: float
) -> list[str]:
    """Run episodes of a cell and return the layers that the failures are blamed on."""
    traces = traced(driver, low, family, level, count, SEED)
    return [diagnose(t, hips).layer for t in traces if t.outcome != "reached"]


def time_windows(trace: Trace) -> Iterator[NDArray[np.bool_]]:
    """Yield masks, (n - 1,), of an episode's intervals in successive stretches of ``LOOK_BACK`` s
    from ``SETTLE`` on."""
    begins, end = trace["time"][:-1], trace["time"][-1]
    for start in np.arange(SETTLE, end - LOOK_BACK + 1e-6, LOOK_BACK):
        yield (begins > start - 1e-6) & (begins < start + LOOK_BACK - 1e-6)


def measured_limits(traces: Sequence[Trace], hips: float) -> Mapping[str, tuple[float, float]]:
    """Bounds that 95 % of the tracking errors in successful episodes stay below.

    Returns:
        The bounds for stretches and for whole episodes, keyed by the names of ``LIMITS``; nan where
        there was no error to judge.
    """
    errors: dict[tuple[str, bool], list[float]] = defaultdict(list)
    for trace in traces:
        clear, whole = free(trace, tile_under(trace), hips), settled(trace)
        for is_whole, intervals in ((True, whole), *((False, s) for s in time_windows(trace))):
            for name, error in tracking_errors(trace, intervals & clear).items():
                errors[name, is_whole].append(error)

    def highest(name: str, is_whole: bool) -> float:
        found = errors[name, is_whole]
        return float(np.percentile(found, _SHARE)) if found else np.nan

    return {name: (highest(name, False), highest(name, True)) for name in LIMITS}


@script("tdgc.benchmark.planted")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.benchmark.planted",
        description="Faults planted in a pair: does the diagnosis blame the layer at fault?",
    )
    shipped = {name: PRETRAINED / name for name in ("low", "high")}
    for name, path in shipped.items():
        parser.add_argument(f"--{name}", type=Path, default=path, help=f"{name} policy (shipped)")
    args = parser.parse_args(arguments)
    low, low_config = load_low(args.low)
    pair = load_high(args.high, low, low_config)
    hips = float(read_geometry(low_config.robot).hips[0, 0])
    print("fault".ljust(38) + "layer".ljust(11) + "".join(f"{name:>9}" for name in FAMILIES))
    right = total = 0
    for fault in FAULTS:
        line = fault.name.ljust(38) + fault.layer.ljust(11)
        for family in FAMILIES:
            layers = blamed(fault.plant(*pair), low, family, LEVELS[family], EPISODES, hips)
            line += f"{layers.count(fault.layer)} of {len(layers)}".rjust(9)
            right, total = right + layers.count(fault.layer), total + len(layers)
        print(line, flush=True)
    print(f"{right} of {total} failures blamed on the layer at fault")
    walked = [
        trace
        for driver in (HierarchyDriver(*pair), BaselineDriver(bounds=low_config.commands))
        for seed in LIMIT_SEEDS
        for family in FAMILIES
        for level in LIMIT_LEVELS
        for trace in traced(driver, low, family, level, LIMIT_EPISODES, seed)
        if trace.outcome == "reached"
    ]
    print(f"\nwithout a fault, {_SHARE} % of {len(walked)} episodes that reached their goals")
    print("error".ljust(11) + f"{f'{LOOK_BACK:g} s':>12}{'limit':>8}{'episode':>12}{'limit':>8}")
    for name, (stretch, episode) in measured_limits(walked, hips).items():
        limit = LIMITS[name]
        print(
            f"{name.ljust(11)}{stretch:>6.2f} {limit.unit:<5}{limit.stretch:>8.2f}"
            f"{episode:>6.2f} {limit.unit:<5}{limit.episode:>8.2f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
