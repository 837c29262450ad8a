"""Frozen weights on disk: a safetensors file beside a JSON sidecar with everything needed to use it."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors.numpy

from lt_lib.envs.layout import Layout
from lt_lib.settings.base import UserError
from lt_lib.store.files import content_digest, write_atomically

FORMAT = 2  # since the scene has friction


def save_frozen(folder: Path, kind: str, arrays: Mapping[str, np.ndarray], layout: Layout, facts: Mapping) -> Path:
    """Writes <kind>.safetensors and then its sidecar <kind>.json; returns the path of the former.

    The sidecar holds the kind, the scene of the training, the checksum and `facts`: the settings and the gates passed.
    """
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

    Raises a one-line UserError for files that are missing, truncated or altered, that are of another kind or format, or
    that were trained in another scene.
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
        expected = sidecar.pop("sidecar_sha256")
        found = (sidecar["kind"], sidecar["format"], sidecar["sha256"], sidecar["layout"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"weights: {sidecar_path} is not a sidecar of frozen weights ({error!r}); freeze them again"
        ) from error
    if found[:2] != (kind, FORMAT):
        raise UserError(
            f"weights: {path} holds kind {found[0]}, format {found[1]}; expected kind {kind}, format {FORMAT}"
        )
    if expected != content_digest(sidecar):
        raise UserError(f"weights: {sidecar_path} was altered (its checksum differs); freeze the weights again")
    if hashlib.sha256(payload).hexdigest() != found[2]:
        raise UserError(
            f"weights: {path} is truncated or altered (checksum differs from {sidecar_path.name}'s); freeze it again"
        )
    if Layout(**found[3]) != layout:
        raise UserError(
            f"weights: {path} was trained in a scene other than layout '{layout.name}'; train it there or use its own"
        )
    return safetensors.numpy.load(payload)


def facts_of(folder: Path, kind: str) -> dict:
    """The facts stored with frozen weights that `load_frozen` has accepted: settings and gates passed."""
    sidecar = json.loads((folder / f"{kind}.json").read_text(encoding="utf-8"))
    beside = ("format", "kind", "sha256", "layout", "sidecar_sha256")
    return {name: value for name, value in sidecar.items() if name not in beside}
