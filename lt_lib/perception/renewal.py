"""Compiled: which frames differ from the ones that are kept, and keeping them.

Kept apart from the annotated functions that call it, since compiled code must not be wrapped by run-time shape checks.
"""

from lt_lib.envs.compiled import compiled


@compiled()
def renew(kept, rows, frames, new):
    """Puts each of the frames (B, words) into its row of `kept` where it is new, and says in `new` (B,) where it is."""
    for b in range(frames.shape[0]):
        new[b] = False
        for i in range(frames.shape[1]):
            if kept[rows[b], i] != frames[b, i]:
                new[b] = True
                break
        if new[b]:
            kept[rows[b]] = frames[b]
