"""Files under params that list entries of one form."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from lt_lib.settings.base import Settings, UserError
from lt_lib.settings.profiles import explain
from lt_lib.settings.strict_yaml import read_yaml

Entry = TypeVar("Entry", bound=Settings)


def read_entries(path: Path, model: type[Entry], key: str) -> dict[str, Entry]:
    """The entries of a file by their field `key`, in the order of the file.

    Raises a one-line UserError for an unreadable file, an entry that does not fit the model, and one that comes twice.
    """
    raw = read_yaml(path)
    if not isinstance(raw, list) or not all(isinstance(each, dict) for each in raw):
        raise UserError(f"{path.name}: expected a list of entries '- {{{key}: ..., ...}}'")
    entries: dict[str, Entry] = {}
    for each in raw:
        entry = parsed(model, each, f"{path.name}: {each.get(key)}")
        name = getattr(entry, key)
        if name in entries:
            raise UserError(f"{path.name}: {name} appears twice")
        entries[name] = entry
    return entries


def parsed(model: type[Entry], entry: Mapping[str, Any], where: str) -> Entry:
    """An entry as a model; pydantic's complaint becomes a one-line UserError that starts with `where`."""
    try:
        return model.model_validate(dict(entry))
    except ValidationError as error:
        raise UserError(explain(error, where, model)) from None
