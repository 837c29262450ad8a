"""What reaches the navigator in the gridworld: Table I's contents, the raw one a patch of 225 cells."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lt_lib.comm.channel import anchor
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.envs.layout import SIDES
from lt_lib.gridworld.map import CODES, Grid
from lt_lib.gridworld.views import Views
from lt_lib.settings.base import require_known


def raw(sender: Sender) -> Float[Tensor, "b 225"]:
    """The patch itself, its cell codes scaled to [0, 1]."""
    return torch.from_numpy(sender.frames).flatten(1) / (len(CODES) - 1)


GRID_CONTENTS = CONTENTS | {"raw": raw}


def contents_sent(grid: Grid, views: Views, content: str) -> Float[Tensor, "m slab c"]:
    """What a scout at each of its m posts sends under either placement. Raises UserError for an unknown content."""
    require_known([content], GRID_CONTENTS, "message content")
    post, slab = (values.ravel() for values in np.indices((len(grid.posts), len(SIDES))))
    pose = np.pad(grid.centres[grid.posts[post]], ((0, 0), (0, 1)))  # a scout on cells has no heading
    still = np.zeros((len(post), 2))
    sender = Sender(grid.layout, views.encoder, views.posts[post, slab], pose, still, slab)
    return GRID_CONTENTS[content](sender).reshape(len(grid.posts), len(SIDES), -1)


def anchors(grid: Grid) -> Float[Tensor, "m p 2"]:
    """Where a scout at each of its posts is, as seen from a navigator in each cell."""
    post, cell = np.broadcast_arrays(grid.centres[grid.posts][:, None], grid.centres)
    flat = anchor(post.reshape(-1, 2), cell.reshape(-1, 2), grid.layout.communication_radius)
    return flat.reshape(len(grid.posts), len(grid.cells), 2)
