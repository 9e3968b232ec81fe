"""MCAP bags: written during a run, read afterwards. Foxglove and ``ros2 bag`` open them as they are."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


@functools.cache
def typestore() -> Any:
    """Definitions of the ROS 2 Jazzy messages."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


class BagRecorder:
    """Writes serialised messages into a bag as they come."""

    def __init__(self, folder: Path) -> None:
        """Create the bag; an older bag in the same folder is replaced.

        Raises:
            FileExistsError: when the folder exists and holds something else than a bag.
        """
        from rosbags.rosbag2 import StoragePlugin, Writer

        if folder.exists():
            if any(folder.iterdir()) and not (folder / "metadata.yaml").exists():
                raise FileExistsError(f"{folder} exists and is not a bag; choose another output folder")
            shutil.rmtree(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def add_topic(self, topic: str, message_type: str) -> None:
        """Announce a topic, for example "/joint_states" of type "sensor_msgs/msg/JointState"."""
        self._connections[topic] = self._writer.add_connection(topic, message_type, typestore=typestore())

    def write(self, topic: str, seconds: float, data: bytes) -> None:
        """Append a serialised message received at a time [s]."""
        self._writer.write(self._connections[topic], round(seconds * 1e9), data)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def read_messages(folder: Path, topics: Iterable[str]) -> Iterator[tuple[str, float, Any]]:
    """Messages of some topics in the order of their time.

    Yields:
        topic, time [s], deserialised message.
    """
    from rosbags.rosbag2 import Reader

    wanted = set(topics)
    with Reader(folder) as reader:
        connections = [connection for connection in reader.connections if connection.topic in wanted]
        if not connections:
            return
        for connection, nanoseconds, data in reader.messages(connections=connections):
            yield connection.topic, nanoseconds * 1e-9, typestore().deserialize_cdr(data, connection.msgtype)
