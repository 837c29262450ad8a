"""Which of our source a function depends on, so that a stored result is used only while that source is unchanged."""

import ast
import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from importlib.util import resolve_name
from pathlib import Path


def source_digest(function: Callable, *classes: type, folder: Path) -> str:
    """sha256 of the code of a function's module, of those of `classes`, and of all of our modules that they import.

    Ours are the modules in `folder`. Comments, docstrings and layout do not count. Imports are read from the source at
    any depth, inside functions too; a module reached only through importlib is missed.
    """
    todo = {function.__module__, *(cls.__module__ for cls in classes)}
    code: dict[str, str] = {}
    while todo:
        for module, path in _modules(folder, todo.pop()):
            if module not in code:
                code[module], imports = _read(path, path.stat().st_mtime_ns, module)
                todo |= imports
    return hashlib.sha256(repr(sorted(code.items())).encode()).hexdigest()


def source_state(function: Callable) -> str:
    """A digest that changes with any edit of the package, or folder, that a function is imported from."""
    top = sys.modules[function.__module__.partition(".")[0]]
    found = {path: path.stat() for path in sorted(Path(top.__file__).parent.rglob("*.py"))}
    state = [(str(path), stat.st_mtime_ns, stat.st_size) for path, stat in found.items()]
    return hashlib.sha256(repr(state).encode()).hexdigest()


def _modules(folder: Path, name: str) -> Iterator[tuple[str, Path]]:
    """Our modules that run when a dotted name is imported, with their files."""
    words = name.split(".")
    for count in range(1, len(words) + 1):
        stem = folder.joinpath(*words[:count])
        for path in (stem.with_suffix(".py"), stem / "__init__.py"):
            if path.is_file():
                yield ".".join(words[:count]), path


@lru_cache(maxsize=1000)
def _read(path: Path, modified_ns: int, module: str) -> tuple[str, frozenset[str]]:
    """The code of a module and the dotted names it imports; `modified_ns` makes the cache notice edits."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    imports = frozenset(_imports(body, module if path.name == "__init__.py" else module.rpartition(".")[0]))
    return "\n".join(ast.dump(_without_docstrings(node)) for node in body if not _is_text(node)), imports


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
