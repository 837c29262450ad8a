"""The encoder E, the predictor P and their frozen form (Sections Encoder and freeze, Implementation)."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.envs.materials import PALETTE
from lt_lib.perception.first_layer import bags
from lt_lib.store.states import only, restored

LATENT = 64
ACTION = 3
CHUNK = 1024  # most observations encoded at once


class Encoder(nn.Module):
    """Maps frames (B, H, W, 3) in [0, 1] to raw latents (B, 64)."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 32, kernel_size=8, stride=4),
            nn.ReLU(inplace=True),  # (B, 32, 15, 15)
            nn.Conv2d(32, 64, kernel_size=4, stride=2),
            nn.ReLU(inplace=True),  # (B, 64, 6, 6)
            nn.Conv2d(64, 64, kernel_size=3, stride=1),
            nn.ReLU(inplace=True),  # (B, 64, 4, 4)
            nn.Flatten(),
            nn.Linear(1024, LATENT),
        ).to(memory_format=torch.channels_last)

    def forward(self, frames: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b 64"]:
        return self.layers(frames.permute(0, 3, 1, 2))  # a channels-last view, no copy


def architecture(encoder: Encoder) -> str:
    """The encoder's layers in the paper's words, read from the module."""
    convolutions = [layer for layer in encoder.layers if isinstance(layer, nn.Conv2d)]
    channels, kernels, strides = (
        ",".join(str(value) for value in values)
        for values in zip(*((c.out_channels, c.kernel_size[0], c.stride[0]) for c in convolutions), strict=True)
    )
    return f"conv {channels} kernels {kernels} strides {strides} linear {encoder.layers[-1].out_features}"


class Predictor(nn.Module):
    """Maps a raw latent and an action to the next raw latent (the paper's z-hat), as a residual."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(LATENT + ACTION, 128), nn.ReLU(), nn.Linear(128, LATENT))

    def forward(self, latent: Float[Tensor, "b 64"], action: Float[Tensor, "b 3"]) -> Float[Tensor, "b 64"]:
        return latent + self.layers(torch.cat([latent, action], dim=1))


class Frozen:
    """E and P after the freeze, without gradients, and the normalisation that was fixed before any policy existed.

    The weights are a flat mapping of arrays ("E.*", "P.*", "mean", "std"), the form in which they are stored and passed
    to runs; an E that was not trained to predict comes without P. A subclass defines E and how observations enter it.
    """

    def __init__(self, encoder: nn.Module, weights: Mapping[str, np.ndarray], device: str, precision: str):
        self.device, self.dtype = torch.device(device), getattr(torch, precision)
        modules = {"E": encoder} | ({"P": Predictor()} if only(weights, "P") else {})
        for prefix, module in modules.items():
            restored(module, weights, prefix).to(self.device, self.dtype).requires_grad_(False)
        self._encoder, self._predictor = encoder, modules.get("P")
        self._mean = torch.tensor(weights["mean"], device=self.device)
        self._std = torch.tensor(weights["std"], device=self.device)

    def inputs(self, observations: UInt8[np.ndarray, "b ..."]) -> Tensor:
        """Observations in the form that E takes."""
        raise NotImplementedError

    @torch.no_grad()
    def latent(self, observations: UInt8[np.ndarray, "b ..."]) -> Float[Tensor, "b 64"]:
        """Normalised latents of observations."""
        return self._normalised(self._encoder(self.inputs(observations)))

    @torch.no_grad()
    def predicted(
        self, observations: UInt8[np.ndarray, "b ..."], action: Float[Tensor, "b 3"]
    ) -> Float[Tensor, "b 64"]:
        """Normalised latents that P predicts for the next observation, given an action."""
        raw = self._encoder(self.inputs(observations))  # (B, 64)
        return self._normalised(self._predictor(raw, action.to(self.device, self.dtype)))

    def _normalised(self, latent: Float[Tensor, "b 64"]) -> Float[Tensor, "b 64"]:
        return (latent.float() - self._mean) / self._std


class FrozenEncoder(Frozen):
    """The frozen form for the fast camera's frames (B, H, W) of palette indices.

    The first convolution is a sum of table rows (`perception.first_layer`), in float32 and on the CPU.

    precision  of what follows it: 'float32', the reference, or 'bfloat16', faster on CPUs that support it
    """

    def __init__(self, weights: Mapping[str, np.ndarray], device: str = "cpu", precision: str = "float32"):
        super().__init__(Encoder(), weights, device, precision)
        first, self._encoder = self._encoder.layers[0], self._encoder.layers[2:]
        self._size, self._stride = first.kernel_size[0], first.stride[0]
        self._table = run_table(weights["E.layers.0.weight"], weights["E.layers.0.bias"])

    def inputs(self, observations: UInt8[np.ndarray, "b h w"]) -> Float[Tensor, "b c j j"]:
        """The first convolution's outputs, rectified before they may lose precision; channels last in memory."""
        places = (observations.shape[1] - self._size) // self._stride + 1
        windows = len(observations) * places**2
        rows, starts = np.empty(windows * (self._size**2 + 1), np.int32), np.empty(windows + 1, np.int32)
        n = bags(observations, self._size, self._stride, len(PALETTE), rows, starts)
        picked = torch.from_numpy(rows[:n]), self._table, torch.from_numpy(starts)
        out = F.embedding_bag(*picked, mode="sum", include_last_offset=True)  # (windows, c)
        return out.relu_().view(-1, places, places, out.shape[1]).permute(0, 3, 1, 2).to(self.device, self.dtype)


def run_table(weight: Float[np.ndarray, "c 3 k k"], bias: Float[np.ndarray, " c"]) -> Float[Tensor, "rows c"]:
    """What every run of one palette colour in a window adds to the first convolution; see `first_layer.bags`."""
    scaled = PALETTE.astype(np.float64) / 255
    pixel = np.einsum("oryx,cr->xyco", weight.astype(np.float64), scaled)  # (k, k, colours, c), the column first
    below = np.concatenate([np.zeros_like(pixel[:, :1]), pixel.cumsum(axis=1)], axis=1)  # (k, k + 1, colours, c)
    runs = below[:, None, 1:] - below[:, :-1, None]  # (k, y0, y1 - 1, colours, c)
    parts = runs.reshape(-1, len(bias)), pixel.sum(axis=(0, 1)) + bias, bias[None]
    return torch.from_numpy(np.concatenate(parts).astype(np.float32))


def in_chunks(encode: Callable[[np.ndarray], Tensor], observations: np.ndarray) -> Float[np.ndarray, "n 64"]:
    """Encodes n observations, CHUNK at a time, which bounds the memory of the activations."""
    parts = [encode(observations[i : i + CHUNK]).cpu() for i in range(0, len(observations), CHUNK)]
    return torch.cat(parts).numpy()
