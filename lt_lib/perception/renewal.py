"""A compiled loop that finds the frames that differ from the stored ones and stores them.

It stands apart from the annotated functions that call it, because run-time shape checks must not wrap compiled code.
"""

from lt_lib.envs.compiled import compiled


@compiled()
def renew(kept, rows, frames, new):
    """Stores each of the frames (B, words) that differs from its row of `kept`, and flags it in `new` (B,)."""
    for b in range(frames.shape[0]):
        new[b] = False
        for i in range(frames.shape[1]):
            if kept[rows[b], i] != frames[b, i]:
                new[b] = True
                break
        if new[b]:
            kept[rows[b]] = frames[b]
