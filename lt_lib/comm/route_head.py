"""The route head: reads the wire, commits to one corridor (Section Route head and executor)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

HIDDEN = 64


class RouteHead(nn.Module):
    """One hidden layer of 64 units feeding two logits and a value; 4,483 parameters on a 66-float wire.

    The logits start at zero, so the first batches hold both routes in equal proportion.
    """

    def __init__(self, width: int, routes: int = 2):
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(width, HIDDEN), nn.ReLU())
        self.logits, self.value = nn.Linear(HIDDEN, routes), nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)

    def policy(self, wire: Float[Tensor, "b w"]) -> torch.distributions.Categorical:
        return self.outlook(wire)[0]

    def outlook(self, wire: Float[Tensor, "b w"]) -> tuple[torch.distributions.Categorical, Float[Tensor, " b"]]:
        """The policy and the value."""
        hidden = self.hidden(wire)
        return torch.distributions.Categorical(logits=self.logits(hidden)), self.value(hidden).squeeze(1)

    def evaluate(self, observations: Float[Tensor, "b w"], actions: Int[Tensor, " b"]):
        """Log-probability, entropy and value, each (b,)."""
        policy, value = self.outlook(observations)
        return policy.log_prob(actions), policy.entropy(), value
