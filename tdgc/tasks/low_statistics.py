"""Sums over the control steps of the low policy's training, and the values logged from them."""

from collections.abc import Mapping

import numpy as np

from tdgc.sim.commands import INDEX, gait_index
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.tasks.statistics import mean_rewards


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


def summarise(sums: Mapping[str, float]) -> dict[str, float]:
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
        n = max(sums.get(f"gait/{gait}/steps", 0.0), 1.0)
        values[f"tracking/{gait}_velocity_rmse"] = (sums.get(f"gait/{gait}/lin", 0.0) / n) ** 0.5
        values[f"tracking/{gait}_yaw_rate_rmse"] = (sums.get(f"gait/{gait}/yaw", 0.0) / n) ** 0.5
        values[f"tracking/{gait}_contact_match"] = sums.get(f"gait/{gait}/match", 0.0) / n
    return values
