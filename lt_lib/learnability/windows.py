"""Windows of clamped Gaussian commands, drawn and cut in one compiled call (Section 'A scalar predictor').

The normals come from interleaved streams of xoshiro128+ (Blackman and Vigna) by the Box-Muller transform, with Cephes'
single-precision logarithm: plain array loops that the CPU vectorises. They are never stored; only each window's mean
command and the sum of its noise are returned.

This is a module of its own because run-time shape checks must not wrap compiled code.
"""

import numpy as np
from numpy import float32, int32, uint32

from lt_lib.envs.compiled import compiled

WORDS, STREAMS = 4, 16  # generator state: 32-bit words per stream, and streams
FULL = float32(1.0)  # full command
PIECE = 320  # pairs of normals per block, which fits the L1 cache
_ROOT_HALF = int32(0x3F3504F3)  # the bits of sqrt(1/2) as a float
_FRACTION = int32(0x007FFFFF)


# numba computes with 64-bit integers unless told otherwise, hence the casts
@compiled()
def _draw_bits(state, out):
    a, b, c, d = state
    for start in range(0, out.size, STREAMS):
        for i in range(STREAMS):
            out[start + i] = uint32(a[i] + d[i])
            e, g = c[i] ^ a[i], d[i] ^ b[i]
            c[i] = e ^ uint32(b[i] << uint32(9))
            b[i] ^= e
            a[i] ^= g
            d[i] = uint32(g << uint32(11)) | (g >> uint32(21))


@compiled(fastmath=True)
def _split(drawn, mantissa, exponent):
    """A uniform number in (0, 1] from 24 random bits, as mantissa * 2^exponent with 1/2 <= mantissa^2 < 2."""
    bits = mantissa.view(int32)
    for i in range(drawn.size):
        mantissa[i] = float32(int32(drawn[i] >> uint32(8))) + float32(0.5)
    for i in range(drawn.size):
        above = int32(bits[i] - _ROOT_HALF)
        exponent[i] = float32(int32(above >> int32(23)) - int32(24))
        bits[i] = int32(int32(above & _FRACTION) + _ROOT_HALF)


@compiled(inline="always")
def _log(mantissa, exponent):
    """Natural logarithm, Cephes' logf."""
    x = mantissa - float32(1)
    y = float32(7.0376836292e-2)
    y = y * x - float32(1.1514610310e-1)
    y = y * x + float32(1.1676998740e-1)
    y = y * x - float32(1.2420140846e-1)
    y = y * x + float32(1.4249322787e-1)
    y = y * x - float32(1.6668057665e-1)
    y = y * x + float32(2.0000714765e-1)
    y = y * x - float32(2.4999993993e-1)
    y = y * x + float32(3.3333331174e-1)
    z = x * x
    return x + (y * x * z - float32(2.12194440e-4) * exponent - float32(0.5) * z) + float32(0.693359375) * exponent


@compiled(inline="always")
def _sine(turn):
    """Sine of an angle within a quarter turn of zero: Taylor polynomial of degree 11, error at most 6e-8."""
    x = float32(2 * np.pi) * turn
    z = x * x
    y = float32(-1 / 39916800)
    y = y * z + float32(1 / 362880)
    y = y * z - float32(1 / 5040)
    y = y * z + float32(1 / 120)
    y = y * z - float32(1 / 6)
    return x + x * z * y


@compiled(fastmath=True)
def _box_muller(mantissa, exponent, drawn, first, second):
    """Two normals from a radius and an angle in the right half of the circle; a random sign adds the left half."""
    for i in range(drawn.size):
        radius = np.sqrt(float32(-2) * _log(mantissa[i], exponent[i]))
        turn = float32(int32(drawn[i] >> uint32(8))) * float32(2**-25) - float32(0.25)
        sign = float32(int32(drawn[i] & uint32(128))) * float32(1 / 64) - float32(1)
        first[i] = radius * _sine(turn)
        second[i] = radius * sign * _sine(float32(0.25) - abs(turn))


@compiled()
def normals(seed, count):
    """`count` standard normals, float32, from a seed (WORDS, STREAMS) of random bits."""
    state, drawn, out = (
        seed.copy(),
        np.empty(2 * PIECE, uint32),
        np.empty(-(-count // (2 * PIECE)) * 2 * PIECE, float32),
    )
    mantissa, exponent = np.empty(PIECE, float32), np.empty(PIECE, float32)
    for start in range(0, count, 2 * PIECE):
        middle, end = start + PIECE, start + 2 * PIECE
        _draw_bits(state, drawn)
        _split(drawn[:PIECE], mantissa, exponent)
        _box_muller(mantissa, exponent, drawn[PIECE:], out[start:middle], out[middle:end])
    return out[:count]


@compiled(fastmath=True)
def _clamp(noise, mean, sigma, steps, means, sums):
    for b in range(mean.size):
        centre, total, drawn = float32(mean[b]), float32(0), float32(0)
        for t in range(b * steps, (b + 1) * steps):
            total += min(max(centre + sigma * noise[t], -FULL), FULL)
            drawn += noise[t]
        means[b], sums[b] = total / steps, drawn


@compiled()
def clamped_windows(seeds, mean, sigma, steps):
    """Windows of `steps` iid commands: their means after the clamp and the sums of their noise before it.

    seeds (R, WORDS, STREAMS) random bits; mean (R, B) and sigma (R, 1) of a command. Returns two (R, B).
    """
    runs, episodes = mean.shape
    means, sums = np.empty((runs, episodes)), np.empty((runs, episodes))
    for r in range(runs):
        noise = normals(seeds[r], episodes * steps)
        _clamp(noise, mean[r], float32(sigma[r, 0]), steps, means[r], sums[r])
    return means, sums
