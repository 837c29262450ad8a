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
    runs, count = np.empty((pixels, size), np.int32), np.empty(pixels, np.int32)  # of each column of a row of windows
    alike = np.empty(pixels, np.int32)  # how many neighbouring columns up to here are all of one and the same colour
    n = 0
    for b in range(frames.shape[0]):
        for i in range(places):
            strip = frames[b, i * stride : i * stride + size]  # (size, P)
            for x in range(pixels):
                begin, count[x] = 0, 0
                for y in range(1, size + 1):
                    if y == size or strip[y, x] != strip[begin, x]:
                        runs[x, count[x]] = (begin * size + y - 1) * colours + strip[begin, x]
                        count[x] += 1
                        begin = y
                alike[x] = count[x] == 1
                if x > 0 and count[x] == 1 and runs[x, 0] == runs[x - 1, 0]:
                    alike[x] += alike[x - 1]
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
                    for k in range(count[left + x]):
                        rows[n] = x * column + runs[left + x, k]
                        n += 1
    starts[frames.shape[0] * places * places] = n
    return n
