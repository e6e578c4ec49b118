"""A calibrated low policy's correction: the commands to give it so that it moves as asked."""

from collections.abc import Mapping, Sequence

import torch as th
from torch import nn

from tdgc.policies.files import PolicyFileError

#: Velocities are corrected up to this share of their ranges, measured from the middle. The policy
#: was not trained outside the ranges, and what it does far outside is of little use. Chosen by
#: hand.
LIMIT = 1.2


def frozen_linear(weight: th.Tensor, bias: th.Tensor) -> nn.Linear:
    """A linear layer of these tensors, not copied and not trained."""
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.load_state_dict({"weight": weight, "bias": bias}, assign=True)
    return layer.requires_grad_(False)


class Correction(nn.Module):
    """Replaces the velocities, the first values of commands, as a network says: (n, c) -> (n, c).

    Commands are float64, the network is float32. It is exactly symmetric: a mirrored command leads
    to the mirrored velocities.

    Args:
        sizes: of the network's layers, from the commands to the velocities.
        tensors: by name, ``zero`` and ``unit``, (c,), middle and half width of the commands'
            ranges; ``sign``, (c,), -1 for commands that change sign in a left-right mirror;
            ``0.weight``, ``0.bias``, ``1.weight``, ..., the network's.

    Raises:
        PolicyFileError: a unit that is not above 0.
    """

    def __init__(self, sizes: Sequence[int], tensors: Mapping[str, th.Tensor]) -> None:
        super().__init__()
        self.sizes = tuple(sizes)
        self.zero, self.unit, self.sign = (tensors[n].double() for n in ("zero", "unit", "sign"))
        if not bool((self.unit > 0.0).all()):
            raise PolicyFileError("the units of a correction must be above 0")
        self.layers = nn.ModuleList(
            frozen_linear(tensors[f"{i}.weight"], tensors[f"{i}.bias"])
            for i in range(len(self.sizes) - 1)
        )

    def forward(self, commands: th.Tensor) -> th.Tensor:
        count = self.sizes[-1]
        zero, unit, sign = (part[:count] for part in (self.zero, self.unit, self.sign))
        both = th.cat([commands, self.sign * commands])
        x = ((both - self.zero) / self.unit).float()
        hidden = x
        for layer in self.layers[:-1]:
            hidden = th.tanh(layer(hidden))
        asked, change = x[:, :count], self.layers[-1](hidden)
        limit = asked.abs().clamp(min=LIMIT)
        velocity = th.minimum(th.maximum(asked + change, -limit), limit)
        seen, mirrored = (zero + unit * velocity.double()).chunk(2)
        return th.cat([0.5 * (seen + sign * mirrored), commands[:, count:]], dim=1)

    def tensors(self) -> dict[str, th.Tensor]:
        """The tensors by their names in a policy's file."""
        named = {"zero": self.zero, "unit": self.unit, "sign": self.sign}
        for i, layer in enumerate(self.layers):
            named |= {f"{i}.{name}": tensor for name, tensor in layer.state_dict().items()}
        return {f"correction.{name}": tensor for name, tensor in named.items()}
