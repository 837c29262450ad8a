"""Whether the guards of an encoder's objective keep its rank up."""

from typing import Any

import numpy as np
from jaxtyping import Float

from lt_lib.perception.gates import effective_rank
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA

PARTS = 6  # groups of rollouts, each with an effective rank of its own


def rank_falls(
    guarded: Float[np.ndarray, "rollouts frames d"], bare: Float[np.ndarray, "rollouts frames d"], *, of: str
) -> dict[str, Any]:
    """Whether latents have a higher effective rank than others, over groups of rollouts (exact rank test)."""
    ranks = [
        [effective_rank(part.reshape(-1, part.shape[-1])) for part in np.array_split(side, PARTS)]
        for side in (guarded, bare)
    ]
    p = stats.rank_test(*ranks)
    means = " and ".join(f"{np.mean(side):.1f}" for side in ranks)
    test = f"exact rank test over {PARTS} groups of rollouts, above {of}: {means}"
    return judges.words(p < ALPHA, test, p=p, n=len(guarded))
