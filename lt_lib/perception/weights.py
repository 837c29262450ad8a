"""Frozen weights on disk: safetensors beside a JSON sidecar with everything that their use needs."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors.numpy

from lt_lib.envs.layout import Layout
from lt_lib.settings.base import UserError
from lt_lib.store.files import content_digest, write_atomically

FORMAT = 1


def save_frozen(folder: Path, kind: str, arrays: Mapping[str, np.ndarray], layout: Layout, facts: Mapping) -> Path:
    """Writes <kind>.safetensors, then <kind>.json: what it is, the scene it was trained in, how, and its checksum."""
    payload = safetensors.numpy.save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
    sidecar = {
        "format": FORMAT,
        "kind": kind,
        "sha256": hashlib.sha256(payload).hexdigest(),
        "layout": layout.model_dump(mode="json"),
        **facts,
    }
    sidecar["sidecar_sha256"] = content_digest(sidecar)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{kind}.safetensors", payload)
    write_atomically(folder / f"{kind}.json", json.dumps(sidecar, indent=1).encode())
    return folder / f"{kind}.safetensors"


def load_frozen(folder: Path, kind: str, layout: Layout) -> dict[str, np.ndarray]:
    """The arrays of frozen weights.

    Raises UserError, one line, for files that are missing, truncated or altered, of another kind or format, or
    trained in another scene.
    """
    path, sidecar_path = folder / f"{kind}.safetensors", folder / f"{kind}.json"
    for needed in (path, sidecar_path):
        if not needed.is_file():
            raise UserError(
                f"weights: {needed} is missing; give a folder that holds {kind}.safetensors and {kind}.json"
            )
    payload = path.read_bytes()
    try:
        sidecar = json.loads(sidecar_path.read_text(encoding="utf-8"))
        expected = sidecar.pop("sidecar_sha256", None)  # sidecars of before it was kept have none
        found = (sidecar["kind"], sidecar["format"], sidecar["sha256"], sidecar["layout"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"weights: {sidecar_path} is no sidecar of frozen weights ({error!r}); freeze them again"
        ) from error
    if found[:2] != (kind, FORMAT):
        raise UserError(f"weights: {path} holds a {found[0]} of format {found[1]}, not a {kind} of format {FORMAT}")
    if expected not in (None, content_digest(sidecar)):
        raise UserError(f"weights: {sidecar_path} is altered (it differs from its checksum); freeze them again")
    if hashlib.sha256(payload).hexdigest() != found[2]:
        raise UserError(
            f"weights: {path} is truncated or altered (checksum differs from {sidecar_path.name}'s); freeze it again"
        )
    if Layout(**found[3]) != layout:
        raise UserError(
            f"weights: {path} was trained in another scene than layout '{layout.name}'; train it there or use its own"
        )
    return safetensors.numpy.load(payload)


def facts_of(folder: Path, kind: str) -> dict:
    """What was recorded with frozen weights that `load_frozen` has accepted: their settings and what they passed."""
    sidecar = json.loads((folder / f"{kind}.json").read_text(encoding="utf-8"))
    beside = ("format", "kind", "sha256", "layout", "sidecar_sha256")
    return {name: value for name, value in sidecar.items() if name not in beside}
