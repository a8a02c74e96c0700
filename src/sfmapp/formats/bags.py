"""Recordings of robots: bags of ROS 1, of ROS 2 (sqlite3 and MCAP) and MCAP files, as topics and the bytes of messages.

rosbags reads the first two, mcap the third; nothing of either is imported before a bag is opened.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Protocol, Self

from sfmapp.errors import InputError, SfmError
from sfmapp.formats.ros_messages import Message
from sfmapp.packages import require

_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
# How ROS serialises messages; MCAP may hold others, such as protobuf and json.
_ENCODINGS = {"ros1": False, "cdr": True}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name, type: such as ``/cam0/image_raw`` and ``sensor_msgs/Image``.
        num_messages: how many there are.
        encoding: how messages are serialised: ``ros1`` or ``cdr``, or a foreign one, which is not read.
    """

    name: str
    type: str
    num_messages: int
    encoding: str


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag: a file by its ending, a folder by its ``metadata.yaml`` and what lies beside."""
    if path.is_dir():
        parts = (entry.name.removesuffix(".zstd") for entry in path.iterdir())
        return (path / _METADATA).is_file() and any(name.endswith((".db3", ".mcap")) for name in parts)
    return path.suffix.lower() in _SUFFIXES or (path.name == _METADATA and is_bag(path.parent))


class Bag:
    """An open bag, to be used in a ``with`` statement.

    Attributes:
        path: of the file, or of the folder with ``metadata.yaml``.
        topics: those that hold messages, by name.
        damage: what is wrong with a file of which a part can be read all the same; empty for nothing.

    Raises:
        InputError: it is no bag, or so damaged that nothing can be read.
        MissingPackageError: the package that reads it is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.parent if path.name == _METADATA else path
        self.damage = ""
        with _named(self.path):
            if self.path.is_file() and self.path.stat().st_size == 0:
                raise InputError(f"{self.path}: expected a bag, found an empty file")
            storage = _McapStorage if self.path.suffix.lower() == ".mcap" else _RosStorage
            self._storage: _Storage = storage(self.path)
            self.damage = self._storage.damage
            self.topics = {topic.name: topic for topic in self._storage.topics if topic.num_messages}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the files back."""
        self._storage.close()

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of some topics, in the order of their recording.

        Raises:
            InputError: what follows cannot be read.
        """
        with _named(self.path):
            yield from self._storage.messages(frozenset(topics))


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Whatever a reader of another package raises on damaged bytes, as a failure that names the file."""
    try:
        yield
    except (SfmError, OSError, ModuleNotFoundError):
        raise
    # they raise KeyError, struct.error, AssertionError, RuntimeError and errors of their own, with no common root
    except Exception as error:
        reason = str(error) or type(error).__name__
        advice = "rosbag reindex repairs bags that were not closed" if path.suffix == ".bag" else None
        raise InputError(f"{path}: expected a whole bag, found a damaged one: {reason}", advice) from error


class _Storage(Protocol):
    topics: list[Topic]
    damage: str

    def messages(self, topics: frozenset[str]) -> Iterator[Message]: ...

    def close(self) -> None: ...


class _RosStorage:
    """Bags of ROS 1, and of ROS 2 in a folder or a single sqlite3 file."""

    def __init__(self, path: Path) -> None:
        require("rosbags")
        self.damage = ""
        self._is_cdr = path.suffix.lower() != ".bag"
        self._reader: Any
        if self._is_cdr:
            from rosbags import rosbag2

            self._reader = rosbag2.Reader(path)
        else:
            from rosbags import rosbag1

            self._reader = rosbag1.Reader(path)
        self._reader.open()
        encoding = "cdr" if self._is_cdr else "ros1"
        # several nodes may publish on a topic
        self.topics = [
            Topic(name, _plain_type(facts.msgtype or ""), facts.msgcount, encoding)
            for name, facts in self._reader.topics.items()
        ]

    def messages(self, topics: frozenset[str]) -> Iterator[Message]:
        wanted = [connection for connection in self._reader.connections if connection.topic in topics]
        if wanted:  # none are all
            for connection, log_ns, data in self._reader.messages(connections=wanted):
                yield Message(connection.topic, log_ns, data, self._is_cdr)

    def close(self) -> None:
        self._reader.close()


class _McapStorage:
    """An MCAP file of any profile. One without an index is read from its beginning, as far as it goes."""

    def __init__(self, path: Path) -> None:
        require("mcap")
        self._path, self.damage = path, ""
        summary: Any = None
        with path.open("rb") as file:
            reader = self._open(file)
            try:
                summary = reader.get_summary()
            except Exception as error:  # as above: a file that was cut off ends anywhere
                self.damage = f"it was not closed ({str(error) or type(error).__name__})"
        self._is_indexed = bool(summary and summary.chunk_indexes and summary.statistics and not self.damage)
        if self._is_indexed:
            counts, schemas = summary.statistics.channel_message_counts, summary.schemas
            found = [
                (one.topic, schemas[one.schema_id].name if one.schema_id else "", one, counts.get(key, 0))
                for key, one in summary.channels.items()
            ]
        else:
            found = self._count()
        topics: dict[str, Topic] = {}
        for name, kind, channel, count in found:
            before = topics[name].num_messages if name in topics else 0
            topics[name] = Topic(name, _plain_type(kind), before + count, channel.message_encoding)
        self.topics = list(topics.values())

    def messages(self, topics: frozenset[str]) -> Iterator[Message]:
        with self._path.open("rb") as file:
            walk = self._walk(file, topics)
            try:
                for _, channel, message in walk:
                    is_cdr = _ENCODINGS.get(channel.message_encoding)
                    if is_cdr is not None:
                        yield Message(channel.topic, message.log_time, message.data, is_cdr)
            except Exception:
                if not self.damage:  # else what is there was read, and what is not was told of
                    raise

    def close(self) -> None:
        """Every walk has a file of its own."""

    def _count(self) -> list[tuple[str, str, Any, int]]:
        found: dict[int, tuple[str, str, Any, int]] = {}
        with self._path.open("rb") as file:
            try:
                for schema, channel, _ in self._walk(file, None):
                    count = found[channel.id][3] if channel.id in found else 0
                    found[channel.id] = channel.topic, schema.name if schema else "", channel, count + 1
            except Exception as error:  # what came before can be read
                if not found:
                    raise
                self.damage = self.damage or f"it cannot be read to its end ({str(error) or type(error).__name__})"
        return list(found.values())

    def _walk(self, file: IO[bytes], topics: frozenset[str] | None) -> Iterator[tuple[Any, Any, Any]]:
        """Schema, channel and message; in the order of the file where there is no index to sort by."""
        from mcap.reader import NonSeekingReader

        reader = self._open(file) if self._is_indexed else NonSeekingReader(file, validate_crcs=True)
        walk: Iterator[tuple[Any, Any, Any]] = reader.iter_messages(topics, log_time_order=self._is_indexed)
        return walk

    @staticmethod
    def _open(file: IO[bytes]) -> Any:
        from mcap.reader import make_reader

        return make_reader(file, validate_crcs=True)


def _plain_type(name: str) -> str:
    """``sensor_msgs/Image``, as ROS 1 has it, of ROS 2's ``sensor_msgs/msg/Image``."""
    return name.replace("/msg/", "/")
