"""The receiver: one cross-attention layer from the navigator to the messages it received (Section Receiver)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class Receiver(nn.Module):
    """Masked attention over any number of senders: the ego embedding is the query, the messages are keys and values.

    The pooled message does not depend on the senders' order, and absent senders contribute exactly zero, even if all
    are. The value projection has no bias and starts at zero, so every condition starts as the no-message policy. With
    one sender the attention is 1 whatever the scores, so query and key get no gradient.

    value_gain  of an orthogonal start of the value projection; 0 is the start at zero
    """

    def __init__(self, ego: int, wire: int, pooled: int, value_gain: float = 0.0):
        super().__init__()
        self.query, self.key = nn.Linear(ego, pooled, bias=False), nn.Linear(wire, pooled, bias=False)
        self.value = nn.Linear(wire, pooled, bias=False)
        nn.init.orthogonal_(self.value.weight, value_gain)

    def forward(
        self, ego: Float[Tensor, "b e"], wires: Float[Tensor, "b n w"], present: Bool[Tensor, "b n"]
    ) -> Float[Tensor, "b d"]:
        """The pooled messages of n senders."""
        weights = self.attention(ego, wires, present)
        return (weights.unsqueeze(1) @ self.value(wires)).squeeze(1)

    def attention(
        self, ego: Float[Tensor, "b e"], wires: Float[Tensor, "b n w"], present: Bool[Tensor, "b n"]
    ) -> Float[Tensor, "b n"]:
        """Attention weight of each sender: a softmax over those present, zero for the others."""
        keys = self.key(wires)
        scores = (keys @ self.query(ego).unsqueeze(2)).squeeze(2) / keys.shape[-1] ** 0.5
        # a row without any sender has no softmax; the finite fill keeps it, and its gradient, from becoming NaN
        scores = scores.masked_fill(~present, torch.finfo(scores.dtype).min)
        return scores.softmax(dim=1) * present
