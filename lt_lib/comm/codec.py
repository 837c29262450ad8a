"""Messages in few bits: a latent's first principal directions, each rounded to one of 2^bits levels; a picture's JPEG.

Directions and levels are fixed once, on frames that belong to no task, and both ends know them.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from sklearn.decomposition import PCA

TAILS = (0.001, 0.999)  # quantiles between which the levels lie
WIDEST = 32  # bits of a float that is sent as it is


class Quantiser(NamedTuple):
    """Uniform levels between two quantiles of each float; whatever lies outside gets the nearest level."""

    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]
    bits: int

    @property
    def step(self) -> Float[np.ndarray, " d"]:
        return (self.high - self.low) / 2**self.bits

    def encode(self, values: Float[np.ndarray, "n d"]) -> Int[np.ndarray, "n d"]:
        """The number of each float's level, 0 to 2^bits - 1."""
        level = np.floor((values - self.low) / self.step)
        return np.clip(level, 0, 2**self.bits - 1).astype(np.int64)

    def decode(self, codes: Int[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """The middle of each level."""
        return self.low + (codes + 0.5) * self.step


def fit_quantiser(values: Float[np.ndarray, "n d"], bits: int) -> Quantiser:
    """Levels between the quantiles TAILS of some values."""
    low, high = np.quantile(values, TAILS, axis=0)
    return Quantiser(low, high, bits)


class Codec(NamedTuple):
    """Sends `directions` of a latent, each in `bits`; with no quantiser as they are, with no projection all 64."""

    projection: PCA | None
    quantiser: Quantiser | None
    floats: int

    @property
    def bits(self) -> int:
        """Bits of a message, without its anchor."""
        return self.floats * (self.quantiser.bits if self.quantiser else WIDEST)

    def encode(self, latents: Float[np.ndarray, "n 64"]) -> np.ndarray:
        """What is sent: (n, floats), whole numbers of levels, or the floats themselves."""
        values = self.projection.transform(latents) if self.projection else latents
        return self.quantiser.encode(values) if self.quantiser else values

    def decode(self, sent: np.ndarray) -> Float[np.ndarray, "n 64"]:
        """The latent as the receiver has it."""
        values = self.quantiser.decode(sent) if self.quantiser else sent
        return self.projection.inverse_transform(values) if self.projection else values


def fit_codec(latents: Float[np.ndarray, "n 64"], directions: int, bits: int) -> Codec:
    """A codec fitted to latents.

    directions  the first principal ones that are sent; all 64 means the latent's own floats
    bits        of each; WIDEST leaves them as they are
    """
    whole = directions == latents.shape[1]
    projection = None if whole else PCA(directions, svd_solver="covariance_eigh").fit(latents)
    values = latents if whole else projection.transform(latents)
    return Codec(projection, None if bits == WIDEST else fit_quantiser(values, bits), directions)


def jpeg_file(picture: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, " bytes"]:
    """The bytes of an RGB picture's JPEG file."""
    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def jpeg(
    pictures: UInt8[np.ndarray, "n h w 3"], quality: int
) -> tuple[UInt8[np.ndarray, "n h w 3"], Int[np.ndarray, " n"]]:
    """Pictures as they come out of their JPEG files, and the files' sizes in bits."""
    files = [jpeg_file(picture, quality) for picture in pictures]
    seen = [np.ascontiguousarray(cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1]) for file in files]
    return np.stack(seen), np.array([8 * file.size for file in files])
