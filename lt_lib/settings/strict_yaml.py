"""YAML as it reads: the core schema of YAML 1.2, in which nothing means something else than it says.

PyYAML follows YAML 1.1, where 1:30 is 90, 0100 is 64, `on` is True and the last of two equal keys wins.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from lt_lib.settings.base import UserError

SCALARS = {  # tag: what matches it, and the characters that it may start with
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    "int": (r"[-+]?(?:0|[1-9][0-9]*)", list("-+0123456789")),
    "float": (r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?", list("-+.0123456789")),
}


class _Strict(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # the compiled parser, where it was built
    yaml_implicit_resolvers = {}  # noqa: RUF012 (PyYAML's own way to replace the inherited ones)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str | int | float | bool):
                raise yaml.MarkedYAMLError(
                    problem=f"a key must be text or a number, got {key!r}", problem_mark=key_node.start_mark
                )
            if key == "<<":
                raise yaml.MarkedYAMLError(
                    problem="merge keys (<<) are not read; write the keys out", problem_mark=key_node.start_mark
                )
            if key in keys:
                raise yaml.MarkedYAMLError(problem=f"{key!r} is given twice", problem_mark=key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge keys are refused above."""


for _tag, (_pattern, _first) in SCALARS.items():
    _Strict.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"^(?:{_pattern})$"), _first)


def read_yaml(path: Path) -> Any:
    """A YAML file's content. Raises a one-line UserError, with the line where there is one, if it cannot be read."""
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Strict)
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise UserError(f"{path.name}: line {line} is not UTF-8; save the file as UTF-8") from None
    except yaml.MarkedYAMLError as error:
        where = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        raise UserError(f"{path.name}:{where} not valid YAML: {error.problem}") from None
    except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise UserError(f"{path.name}: cannot be read: {' '.join(str(error).split())}") from None
