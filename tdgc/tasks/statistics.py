"""Sums over training steps, and the values that the training of either policy logs from them."""

from collections.abc import Mapping

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
