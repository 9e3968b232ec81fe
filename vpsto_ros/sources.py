"""What code is running: digests of source files, for caches and records of what the code has made."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import pathlib
import re
from collections.abc import Iterable

PACKAGES = ("vpsto_ros", "sim_bridge")
"""The packages whose code decides what a kernel or an experiment computes."""

_IMPORTED = re.compile(rf"^(?:from|import)\s+((?:{'|'.join(PACKAGES)})\b[\w.]*)", re.MULTILINE)
_DATA = ("*.xml", "*.json")


def digest(files: Iterable[pathlib.Path]) -> str:
    """A digest of names and contents, whatever the order; the folder that the packages lie in does not count.

    Raises:
        OSError: when a file cannot be read.
    """
    total = hashlib.sha256()
    for name, content in sorted((f"{file.parent.name}/{file.name}", _content(file)) for file in files):
        total.update(f"{name} {hashlib.sha256(content).hexdigest()}\n".encode())
    return total.hexdigest()


def package_files() -> list[pathlib.Path]:
    """All Python sources and models of these packages, as far as they are installed."""
    folders = [folder for folder in map(_folder, PACKAGES) if folder is not None]
    return [file for folder in folders for pattern in ("*.py", *_DATA) for file in folder.rglob(pattern)]


def dependencies(file: pathlib.Path) -> frozenset[pathlib.Path]:
    """A source file and all those of these packages that it imports at its top, and these import, and so on.

    Where a package is imported from, all of its modules count, and where there are models beside
    a module, these too.
    """
    known: set[pathlib.Path] = set()
    new = {file}
    while new:
        known |= new
        new = {other for one in new for other in _imported(one)} - known
    return frozenset(known)


@functools.cache
def _imported(file: pathlib.Path) -> frozenset[pathlib.Path]:
    found = {model for pattern in _DATA for model in (file.parent / "models").glob(pattern)}
    if file.suffix == ".py":
        for name in set(_IMPORTED.findall(_content(file).decode())):
            found.update(_files_of(name))
    return frozenset(found)


@functools.cache
def _files_of(name: str) -> tuple[pathlib.Path, ...]:
    """The file of a module; for a package those of all its modules, which may be imported from there."""
    top, *rest = name.split(".")
    folder = _folder(top)
    if folder is None:
        return ()
    path = folder.joinpath(*rest)
    if path.is_dir():
        return tuple(path.glob("*.py"))
    module = path.with_suffix(".py")
    return (module,) if module.exists() else ()


@functools.cache
def _content(file: pathlib.Path) -> bytes:
    """As it was when first asked for, about what this process has imported; later edits do not count."""
    return file.read_bytes()


@functools.cache
def _folder(package: str) -> pathlib.Path | None:
    spec = importlib.util.find_spec(package)
    return pathlib.Path(spec.origin).parent if spec is not None and spec.origin else None
