"""Finished runs on disk: appended one by one, so that a crash loses at most the one being written.

A record belongs to the code that computed it: results of other code are never taken over.
"""

from __future__ import annotations

import io
import os
import pathlib
import pickle
import struct
import sys
import zlib
from collections.abc import Callable
from typing import Any

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.sources import digest, package_files

FORMAT = b"vpsto runs "
MAGIC = FORMAT + b"2\n"
CODE_BYTES = 64
"""After the first line: the digest of the code in hexadecimal digits."""
HEADER = struct.Struct("<16sQI")
"""Fingerprint of the task, length of the pickled result, checksum of that pickle."""


def fingerprint(trial: Callable[[Any], Any], task: Any) -> bytes:
    """What identifies a run within a record: the trial's name and the value of the task, 16 bytes.

    Raises:
        InvalidInputError: when the task cannot be pickled.
    """
    import joblib

    try:
        digest = joblib.hash((trial.__module__, trial.__qualname__, task))
    except Exception as error:  # pickle raises PicklingError, TypeError or AttributeError, as it happens
        raise InvalidInputError(f"a task of {trial.__qualname__} cannot be pickled: {error}") from error
    return bytes.fromhex(digest)


def code_digest(trial: Callable[[Any], Any]) -> str:
    """Digest of the code that a result depends on: all sources and models here and the trial's own file.

    A change of a comment counts as well: which change matters, only a run could tell.
    """
    files = package_files()
    own = getattr(sys.modules.get(trial.__module__), "__file__", None)
    if own is not None and pathlib.Path(own) not in files:
        files.append(pathlib.Path(own))
    return digest(files)


class RunStore:
    """Results in a file, each under the fingerprint of its task.

    The file is a log: a magic line, the digest of the code, then records of a header and a pickle. Whatever
    a killed process left half written at the end is cut off when the file is opened again.

    Attributes:
        path: of the file.
        finished: results by fingerprint.
        outdated: where a record of other code that should have been kept now is, None if there was none.
    """

    def __init__(self, path: pathlib.Path, *, keep: bool, code: str = "0" * CODE_BYTES) -> None:
        """Open a store.

        Args:
            path: of the file; its folder is made if need be.
            keep: read what is there and append to it; otherwise an old file is replaced. A file of other
                code is put aside.
            code: digest of the code that computes the results.

        Raises:
            InvalidInputError: when the file to be kept is something else.
        """
        self.path = path
        self.finished: dict[bytes, Any] = {}
        self.outdated: pathlib.Path | None = None
        self._head = MAGIC + code.encode()
        path.parent.mkdir(parents=True, exist_ok=True)
        end = self._read() if keep and path.exists() else 0
        self._file: io.BufferedRandom = open(path, "r+b" if end else "w+b")  # noqa: SIM115 (open for many appends)
        self._file.truncate(end)
        self._file.seek(end)
        if not end:
            self._file.write(self._head)
            self._file.flush()

    def _read(self) -> int:
        """Load all whole records; returns the position behind the last one, 0 for an empty file."""
        data = self.path.read_bytes()
        if not data.startswith(self._head):
            if self._head.startswith(data):  # the process died before the head was out
                return 0
            if not data.startswith(FORMAT):
                hint = "choose another --out or remove it"
                raise InvalidInputError(f"{self.path} is not a record of runs; {hint}")
            self.outdated = self.path.replace(self.path.with_name(f"{self.path.name}.other_code"))
            return 0
        end = len(self._head)
        while end + HEADER.size <= len(data):
            key, length, checksum = HEADER.unpack_from(data, end)
            payload = data[end + HEADER.size : end + HEADER.size + length]
            if len(payload) < length or zlib.crc32(payload) != checksum:
                break
            self._load(key, payload)
            end += HEADER.size + length
        return end

    def _load(self, key: bytes, payload: bytes) -> None:
        try:
            self.finished[key] = pickle.loads(payload)
        except Exception:  # written by code whose classes have since moved: such a run is done again
            self.finished.pop(key, None)

    def append(self, key: bytes, result: Any) -> None:
        """Add a result; it is with the operating system when this returns."""
        payload = pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
        self._file.write(HEADER.pack(key, len(payload), zlib.crc32(payload)) + payload)
        self._file.flush()

    def close(self) -> None:
        """Write what is left to the disk."""
        os.fsync(self._file.fileno())
        self._file.close()

    def __enter__(self) -> RunStore:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()
