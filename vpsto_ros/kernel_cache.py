"""Compiled kernels are cached on disk; importing this makes the cache notice edits in other files, too.

Numba checks the file that a kernel is in. A kernel of another file that was compiled into it, or a constant
from there, may change unnoticed, and old machine code would run. For kernels of these packages, the stamp of
a cache entry is therefore made of all files of theirs that the kernel's file depends on. An entry with
another stamp is compiled again and replaced, so that nothing piles up. Where entries lie is Numba's choice as
before: the folder named by NUMBA_CACHE_DIR, ``__pycache__`` beside the source, or the user's cache if that
cannot be written to.

Every room with kernels imports this first. Numba has no public way to do this for some functions only; should
its internals be others one day, its own check remains.
"""

from __future__ import annotations

import contextlib
import functools
import pathlib
from typing import Any

from numba.core.caching import FunctionCache

from vpsto_ros.sources import PACKAGES, dependencies, digest


@functools.cache
def stamp(file: str) -> str:
    """Digest of all that a kernel in this file may have been compiled from."""
    return digest(dependencies(pathlib.Path(file)))


def noticing(locator: Any) -> Any:
    """A cache locator of Numba's, for kernels of these packages only, that notices edits in other files."""

    class Noticing(locator):
        noticing = True

        @classmethod
        def from_function(cls, function: Any, file: str) -> Any:
            """The locator of a function, None if it is not for this class."""
            ours = function.__module__.partition(".")[0] in PACKAGES and pathlib.Path(file).is_file()
            return super().from_function(function, file) if ours else None

        def get_source_stamp(self) -> Any:
            """What a cache entry must have been compiled from to be used."""
            return super().get_source_stamp(), stamp(self._py_file)

    return Noticing


def register() -> None:
    """Put these locators before Numba's own; once is enough."""
    implementation = FunctionCache._impl_class
    theirs = list(implementation._locator_classes)
    if not any(getattr(locator, "noticing", False) for locator in theirs):
        implementation._locator_classes = [noticing(locator) for locator in theirs] + theirs


with contextlib.suppress(AttributeError):  # internals of a later Numba
    register()
