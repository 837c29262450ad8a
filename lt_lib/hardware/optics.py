"""The surrogate camera from the lens to the file (Section Hardware), and the crop that an encoder is given.

A picture passes, in this order: lens distortion, vignetting, motion blur, exposure and white balance, the colour mosaic
with shot and read noise, interpolation of the mosaic, gamma, eight bits, JPEG.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.settings.hardware import OpticsConfig

FOV = 32.0  # degrees that the crop subtends
CROP = 64  # side in pixels of what an encoder is given
WIDTH, HEIGHT = 160, 120  # pixels of a frame of the surrogate camera, whose central 64 x 64 are the crop
OVERSAMPLING = 2  # rendered pixels per pixel, along each axis
FOCAL = CROP / 2 / np.tan(np.deg2rad(FOV) / 2)  # pixels
CORNER = (WIDTH - 1 / OVERSAMPLING) ** 2 + (HEIGHT - 1 / OVERSAMPLING) ** 2  # square of the frame's diagonal, pixels
MARGIN = 1.1  # of the frame's width, rendered so that a distorted frame has no empty corner


class Shot(NamedTuple):
    """What differs from one exposure to the next; a session keeps one random stream of them."""

    exposure: float  # factor on the light
    balance: Float[np.ndarray, "3"]  # factors on red, green and blue
    blur: Float[np.ndarray, "2"]  # pixels right and down that the picture moves


def rendered_size(size: tuple[int, int] = (WIDTH, HEIGHT)) -> tuple[int, int]:
    """Width and height in pixels of the picture that `expose` takes for a frame of this size, or for a central part."""
    return tuple(round(MARGIN * OVERSAMPLING * side / 2) * 2 for side in size)


def draw_shot(optics: OpticsConfig, rng: np.random.Generator) -> Shot:
    angle = rng.uniform(0, 2 * np.pi)
    red, blue = np.exp(optics.balance * rng.normal(size=2))
    exposure = 2.0 ** (optics.exposure * rng.normal())
    return Shot(exposure, np.array([red, 1.0, blue]), optics.blur * np.array([np.cos(angle), np.sin(angle)]))


def expose(
    picture: UInt8[np.ndarray, "h w 3"],
    optics: OpticsConfig,
    shot: Shot,
    rng: np.random.Generator,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> UInt8[np.ndarray, "fh fw 3"]:
    """A frame of the camera, RGB, from a rendered picture of `rendered_size`.

    size  width and height in pixels: of the whole frame, or of a central part of it
    """
    light = linear(picture)
    light = _blurred(_through_lens(light, optics, size), shot.blur)
    light = cv2.resize(light, size, interpolation=cv2.INTER_AREA) * (shot.exposure * shot.balance)
    return _developed(_sensed(light, optics, rng), optics)


def crop(frame: UInt8[np.ndarray, "h w 3"], side: int = CROP) -> UInt8[np.ndarray, "64 64 3"]:
    """The central `side` x `side` pixels, which subtend 32 degrees, as the encoder's 64 x 64."""
    top, left = (frame.shape[0] - side) // 2, (frame.shape[1] - side) // 2
    centre = np.ascontiguousarray(frame[top : top + side, left : left + side])
    return centre if side == CROP else cv2.resize(centre, (CROP, CROP), interpolation=cv2.INTER_AREA)


def linear(picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Light, 1 at white, of a picture in sRGB."""
    c = picture.astype(np.float32) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encoded(light: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB, eight bits, of light clipped to [0, 1]."""
    c = np.clip(light, 0, 1)
    return np.round(255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)).astype(np.uint8)


def _through_lens(light, optics: OpticsConfig, size: tuple[int, int]):
    """Radial distortion and vignetting; out comes the frame without the margin, oversampled."""
    (width, height), focal = (side * OVERSAMPLING for side in size), FOCAL * OVERSAMPLING
    u, v = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    r2 = u**2 + v**2
    stretch = focal * (1 + optics.distortion * r2)
    x, y = u * stretch + light.shape[1] / 2 - 0.5, v * stretch + light.shape[0] / 2 - 0.5
    bent = cv2.remap(light, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return bent * (1 - optics.vignetting * r2 * (2 * FOCAL) ** 2 / CORNER)[..., None].astype(np.float32)


def _blurred(light, shift: Float[np.ndarray, "2"]):
    """Mean of the picture along a straight motion of `shift` pixels of the frame."""
    half = int(np.ceil(np.abs(shift).max() * OVERSAMPLING / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    along = np.linspace(-0.5, 0.5, 8 * half + 1)[:, None] * shift * OVERSAMPLING + half  # x, y in the kernel
    corner, part = np.floor(along).astype(int), along % 1
    for dx, dy in np.ndindex(2, 2):  # each point shared among its four neighbours
        share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
        np.add.at(kernel, (corner[:, 1] + dy, corner[:, 0] + dx), share)
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _sensed(light, optics: OpticsConfig, rng: np.random.Generator):
    """What the sensor counts, over the full well, three colours per pixel again; (H, W, 3) in [0, 1]."""
    if not optics.mosaic:
        return _counted(light, optics, rng)
    single = np.empty(light.shape[:2], np.float32)
    for (dy, dx), colour in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():  # RGGB
        single[dy::2, dx::2] = light[dy::2, dx::2, colour]
    raw = np.round(65535 * _counted(single, optics, rng)).astype(np.uint16)
    return cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB).astype(np.float32) / 65535


def _counted(light, optics: OpticsConfig, rng: np.random.Generator):
    """Poisson's electrons and the reading of them, over the full well, clipped to [0, 1]."""
    electrons = rng.poisson(np.clip(light, 0, 1) * optics.full_well) + optics.read_noise * rng.normal(size=light.shape)
    return np.clip(electrons / optics.full_well, 0, 1).astype(np.float32)


def _developed(light, optics: OpticsConfig):
    """Gamma, eight bits, JPEG and back."""
    ok, file = cv2.imencode(".jpg", encoded(light)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, optics.jpeg])
    assert ok, "OpenCV could not write a JPEG"
    return np.ascontiguousarray(cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1])
