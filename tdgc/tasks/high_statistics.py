"""Logged values of the high policy's training, from sums over its decisions."""

from collections.abc import Mapping

from tdgc.sim.gaits import GAITS
from tdgc.tasks.statistics import mean_rewards


def summarise(sums: Mapping[str, float]) -> dict[str, float]:
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
