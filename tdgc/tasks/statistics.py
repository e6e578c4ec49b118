"""Sums over training steps, and the values that the training of either policy logs from them."""

from collections.abc import Mapping

import numpy as np

from tdgc.sim.commands import INDEX, gait_index
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array


class Sums(dict[str, float]):
    """Named running sums."""

    def add(self, name: str, value: float) -> None:
        """Add ``value`` to the sum ``name``, which starts at 0."""
        self[name] = self.get(name, 0.0) + float(value)

    def add_rewards(self, terms: Mapping[str, Array], reward: Array) -> None:
        """Add one step of M robots: its reward (M,) and the reward terms, (M,) each."""
        self.add("steps", len(reward))
        self.add("reward", reward.sum())
        for name, value in terms.items():
            self.add(f"term/{name}", value.sum())


def mean_rewards(sums: Mapping[str, float]) -> dict[str, float]:
    """Mean reward and reward terms per step, from ``Sums`` added over all workers."""
    steps = max(sums.get("steps", 0.0), 1.0)
    terms = {k.removeprefix("term/"): v for k, v in sums.items() if k.startswith("term/")}
    return {"reward/total": sums.get("reward", 0.0) / steps} | {
        f"reward/{name}": value / steps for name, value in terms.items()
    }


def by_gait(loco: Locomotion, terms: Mapping[str, Array]) -> dict[str, Array]:
    """Sums over the robots in each gait after a control step, (4,) each.

    ``steps``: number of robots; ``lin`` and ``yaw``: squared errors of the velocity, m^2/s^2, and
    the yaw rate, rad^2/s^2; ``match``: share of feet whose contact is as desired;
    ``track_lin_vel`` and ``track_yaw_rate``: these reward ``terms``, 0 if switched off.
    """
    state, nothing = loco.world.state, np.zeros(loco.num_robots)
    samples = {
        "steps": np.ones(loco.num_robots),
        "lin": np.sum((state.heading_vel[:, :2] - loco.command[:, :2]) ** 2, axis=1),
        "yaw": (state.ang_vel[:, 2] - loco.command[:, INDEX["yaw_rate"]]) ** 2,
        "match": np.mean(state.touching == (loco.clock.contact > 0.5), axis=1),
        "track_lin_vel": terms.get("track_lin_vel", nothing),
        "track_yaw_rate": terms.get("track_yaw_rate", nothing),
    }
    sums = np.stack(list(samples.values())) @ np.eye(len(GAITS))[gait_index(loco.command)]
    return dict(zip(samples, sums, strict=True))


def summarise_low(sums: Mapping[str, float]) -> dict[str, float]:
    """Turn ``LowLevelTask.take_stats``, summed over all workers, into values to log."""
    values = mean_rewards(sums)
    values["falls_per_minute"] = sums.get("falls", 0.0) / (sums.get("minutes", 0.0) or 1.0)
    for key, value in sums.items():
        kind, _, name = key.partition("/")
        if kind == "share":
            values[f"command_share/{name}"] = value / sums["robots"]
        elif kind == "landing":
            values[key] = value / sums["leapers"]
        elif kind == "level" and name.endswith("/level"):
            family = name.removesuffix("/level")
            count = sums[f"level/{family}/count"]
            if count:  # with few robots, none may be on tiles of the family
                values[f"level/{family}"] = value / count
    for gait in GAITS:
        n = sums.get(f"gait/{gait}/steps")
        if n:  # no robot may have been commanded to walk in this gait
            values[f"tracking/{gait}_velocity_rmse"] = (sums[f"gait/{gait}/lin"] / n) ** 0.5
            values[f"tracking/{gait}_yaw_rate_rmse"] = (sums[f"gait/{gait}/yaw"] / n) ** 0.5
            values[f"tracking/{gait}_contact_match"] = sums[f"gait/{gait}/match"] / n
    return values


def summarise_high(sums: Mapping[str, float]) -> dict[str, float]:
    """Turn ``NavigationTask.take_stats``, summed over all workers, into values to log."""
    values = mean_rewards(sums)
    counts = [k for k in sums if k.startswith("family/") and k.endswith("/count")]
    families = [k.removeprefix("family/").removesuffix("/count") for k in counts]
    for family in families:
        count = sums[f"family/{family}/count"]
        if not count:  # too few robots for all families
            continue
        values[f"level/{family}"] = sums[f"family/{family}/level"] / count
        episodes = sums[f"family/{family}/episodes"]
        if episodes:
            values[f"success/{family}"] = sums[f"family/{family}/reached"] / episodes
        for gait in GAITS:
            values[f"gait/{family}_{gait}"] = sums[f"family/{family}/{gait}"] / count
    return values
