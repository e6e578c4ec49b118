"""Sums over the steps of a training, and what both trainings log of them."""

from collections.abc import Mapping

from tdgc.sim.robot import Array


class Sums(dict[str, float]):
    """Numbers that are added up by name."""

    def add(self, name: str, value: float) -> None:
        """Add to one of them, which begins at 0."""
        self[name] = self.get(name, 0.0) + float(value)

    def add_rewards(self, terms: Mapping[str, Array], reward: Array) -> None:
        """Add a step of M robots: its reward (M,) and the reward's terms, (M,) each."""
        self.add("steps", len(reward))
        self.add("reward", reward.sum())
        for name, value in terms.items():
            self.add(f"term/{name}", value.sum())


def mean_rewards(sums: Mapping[str, float]) -> dict[str, float]:
    """Mean of the reward and of each of its terms per step, of ``Sums`` over all workers."""
    steps = max(sums.get("steps", 0.0), 1.0)
    terms = {k.removeprefix("term/"): v for k, v in sums.items() if k.startswith("term/")}
    return {"reward/total": sums.get("reward", 0.0) / steps} | {
        f"reward/{name}": value / steps for name, value in terms.items()
    }
