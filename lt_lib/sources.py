"""Which of our source a function depends on, so that a kept result is used only while that source stands."""

import ast
import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from importlib.util import resolve_name
from pathlib import Path

# Every module imports its settings from here, so of this one only the definitions imported by name count.
BY_DEFINITION = "lt_lib.params"


def source_digest(function: Callable, *classes: type, folder: Path) -> str:
    """sha256 of the code of a function's module, of `classes`, and of all of our modules imported from there.

    Ours is what lies in `folder`. Comments, docstrings and layout do not count. Imports are read from the
    source at any depth, inside functions too; a module reached only through importlib is not seen.
    """
    todo = {function.__module__, *(f"{cls.__module__}.{cls.__qualname__}" for cls in classes)}
    code: dict[tuple[str, str], str] = {}
    while todo:
        for module, definition, path in _modules(folder, todo.pop()):
            part = (module, definition if module == BY_DEFINITION else "")
            if part not in code:
                code[part], imports = _read(path, path.stat().st_mtime_ns, *part)
                todo |= imports
    return hashlib.sha256(repr(sorted(code.items())).encode()).hexdigest()


def source_state(function: Callable) -> str:
    """Changes with any edit of the package, or of the folder, that a function is imported from."""
    top = sys.modules[function.__module__.partition(".")[0]]
    found = {path: path.stat() for path in sorted(Path(top.__file__).parent.rglob("*.py"))}
    state = [(str(path), stat.st_mtime_ns, stat.st_size) for path, stat in found.items()]
    return hashlib.sha256(repr(state).encode()).hexdigest()


def _modules(folder: Path, name: str) -> Iterator[tuple[str, str, Path]]:
    """Our modules that importing a dotted name runs: (module, the next word of the name or '', file)."""
    words = name.split(".")
    for count in range(1, len(words) + 1):
        stem = folder.joinpath(*words[:count])
        for path in (stem.with_suffix(".py"), stem / "__init__.py"):
            if path.is_file():
                yield ".".join(words[:count]), "".join(words[count : count + 1]), path


@lru_cache(maxsize=1000)
def _read(path: Path, modified_ns: int, module: str, definition: str) -> tuple[str, frozenset[str]]:
    """The code of a module, or of one definition and what it uses there, and the dotted names it imports.

    `modified_ns` is the file's time, so that an edited file is read anew.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    body = _used_by(definition, tree.body) if definition else tree.body
    imports = frozenset(_imports(body, module if path.name == "__init__.py" else module.rpartition(".")[0]))
    return "\n".join(ast.dump(_without_docstrings(node)) for node in body if not _is_text(node)), imports


def _used_by(definition: str, body: Sequence[ast.stmt]) -> Sequence[ast.stmt]:
    """The statements that define a name and the names it uses; all of them if none defines it."""
    defined = {name: node for node in body for name in _names_defined(node)}
    if definition not in defined:
        return body
    todo, used = [definition], {}
    while todo:
        name = todo.pop()
        if name in defined and name not in used:
            used[name] = defined[name]
            todo += [node.id for node in ast.walk(used[name]) if isinstance(node, ast.Name)]
    return [used[name] for name in sorted(used)]


def _names_defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def _imports(body: Sequence[ast.stmt], package: str) -> Iterator[str]:
    """The dotted names imported anywhere in `body`: 'a.b' for `import a.b` and for `from a import b`."""
    for node in (inner for statement in body for inner in ast.walk(statement)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _without_docstrings(statement: ast.stmt) -> ast.stmt:
    for node in ast.walk(statement):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            node.body = [inner for inner in node.body if not _is_text(inner)]
    return statement
