"""The encoder's first convolution on frames of palette indices, by tables instead of multiplications.

Upright shapes under flat light show every column of a window as a few runs of one colour, and most windows as a single
one. What a run adds to the convolution is a row of a table, and the convolution is a sum of rows: an embedding bag.

The compiled loop stands apart from annotated functions, because run-time shape checks must not wrap compiled code.
"""

import numpy as np

from lt_lib.envs.compiled import compiled


@compiled()
def bags(frames, size, stride, colours, rows, starts):
    """Writes, for every window of B frames (B, P, P), the table's rows that make it up; returns how many there are.

    size, stride  of the windows, pixels
    colours       of the palette
    rows          (at least the number returned,) of the table: a run from y0 to before y1 of colour c in column x of
                  the window is row ((x * size + y0) * size + y1 - 1) * colours + c; behind these stand one row for a
                  window all of colour c and one for the bias of every other window
    starts        (windows + 1,) where each window's rows start
    """
    pixels, places, column = frames.shape[1], (frames.shape[1] - size) // stride + 1, size * size * colours
    bent = np.empty(pixels, frames.dtype)  # not 0 where a column of a row of windows has more than one colour
    alike = np.empty(pixels, np.int32)  # how many neighbouring columns up to here are all of one and the same colour
    n = 0
    for b in range(frames.shape[0]):
        for i in range(places):
            strip = frames[b, i * stride : i * stride + size]  # (size, P)
            bent[:] = 0
            for y in range(1, size):
                above, here = strip[y - 1], strip[y]
                for x in range(pixels):  # without a branch, so that many columns are compared at once
                    bent[x] |= above[x] ^ here[x]
            same = 0
            for x in range(pixels):
                same = 0 if bent[x] else same + 1 if same > 0 and strip[0, x] == strip[0, x - 1] else 1
                alike[x] = same
            for j in range(places):
                starts[(b * places + i) * places + j] = n
                left = j * stride
                if alike[left + size - 1] >= size:
                    rows[n] = size * column + strip[0, left]
                    n += 1
                    continue
                rows[n] = size * column + colours
                n += 1
                for x in range(size):
                    begin, seen = 0, strip[:, left + x]
                    for y in range(1, size if bent[left + x] else 1):
                        if seen[y] != seen[begin]:
                            rows[n] = x * column + (begin * size + y - 1) * colours + seen[begin]
                            n += 1
                            begin = y
                    rows[n] = x * column + (begin * size + size - 1) * colours + seen[begin]
                    n += 1
    starts[frames.shape[0] * places * places] = n
    return n
