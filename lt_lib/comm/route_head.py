"""The route head: reads the wire, commits to one corridor (Section Route head and executor)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

HIDDEN = 64
Outlook = tuple[torch.distributions.Categorical, Float[Tensor, " b"]]  # a policy, and the value


class Chooser(nn.Module):
    """What chooses a route from an observation; a subclass says how it looks at one."""

    def outlook(self, observations: Float[Tensor, "b d"]) -> Outlook:
        """The policy and the value."""
        raise NotImplementedError

    def policy(self, observations: Float[Tensor, "b d"]) -> torch.distributions.Categorical:
        return self.outlook(observations)[0]

    @torch.no_grad()
    def greedy(self, observations: Float[Tensor, "b d"]) -> Int[np.ndarray, " b"]:
        """The likeliest route of each."""
        return self.policy(observations).logits.argmax(1).numpy()

    def evaluate(self, observations: Float[Tensor, "b d"], actions: Int[Tensor, " b"]):
        """Log-probability, entropy and value, each (b,)."""
        policy, value = self.outlook(observations)
        return policy.log_prob(actions), policy.entropy(), value


class RouteHead(Chooser):
    """One hidden layer of 64 units feeding two logits and a value; 4,483 parameters on a 66-float wire.

    The logits start at zero, so the first batches hold both routes in equal proportion.
    """

    def __init__(self, width: int, routes: int = 2):
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(width, HIDDEN), nn.ReLU())
        self.logits, self.value = nn.Linear(HIDDEN, routes), nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)

    def outlook(self, observations: Float[Tensor, "b w"]) -> Outlook:
        """The policy and the value on wires."""
        hidden = self.hidden(observations)
        return torch.distributions.Categorical(logits=self.logits(hidden)), self.value(hidden).squeeze(1)
