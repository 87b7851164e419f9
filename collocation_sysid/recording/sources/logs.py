"""Logs of robots: ROS 1 and 2 bags, MCAP files, and LeRobot datasets.

In place of a file, a topic of a log may be given, as in ``run.mcap#/force``; it is read as the
table that `topics` makes of its messages. Further parts follow after a ``#`` each: two frames, as
in ``run.mcap#/tf#base>tool``, a robot's description, and the episode of a dataset.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from ...common.array_types import Array
from ...common.files import reason, require_regular
from ...errors import InputError, hint_at, listed

TOPIC_SEPARATOR = "#"
# Of the positions of joints.
ANGLE_UNITS = ("rad", "deg")
_NEEDS = "logs and trajectories of robots need {}: pip install 'collocation-sysid[logs]'"


@dataclass(frozen=True)
class TopicAddress:
    """A topic of a log, and options for reading it."""

    log: Path  # file, or folder of a bag or of a dataset
    topic: str
    # tuple of (parent, child) or None: frames of a transform: the pose of the child in the parent
    # is read.
    frames: tuple[str, str] | None = None
    # URDF file, relative to the log's folder, that converts joint positions to poses.
    robot: Path | None = None
    unit: str | None = None  # unit of joint angles; None for the log's own
    episode: int | None = None  # episode of a dataset, counted from 0

    @classmethod
    def from_path(cls, path: str | Path) -> TopicAddress | None:
        """Return the address that a path states, ``LOG#TOPIC`` and further parts behind a ``#``
        each; None for a path without ``#``, of an existing file, or whose log does not exist.

        Raises
        ------
        InputError
            If a part behind the topic is not understood.
        """
        log, mark, rest = str(path).partition(TOPIC_SEPARATOR)
        if not mark or Path(path).exists() or not Path(log).exists():
            return None
        topic, *more = rest.split(TOPIC_SEPARATOR)
        options: dict[str, Any] = {}
        for part in more:
            if ">" in part:
                parent, _, child = part.partition(">")
                options["frames"] = parent.strip(), child.strip()
            elif part.lower().endswith((".urdf", ".xml")):
                options["robot"] = Path(log).parent / part
            elif part in ANGLE_UNITS:
                options["unit"] = part
            elif part.isdecimal():
                options["episode"] = int(part)
            else:
                expected = (
                    "two frames PARENT>CHILD, the file of a robot (.urdf), rad or deg, or the index of an "
                    "episode"
                )
                raise InputError(f"found {part!r} after the topic; expected {expected}")
        return cls(Path(log), topic, **options)


def stored_files(path: str | Path) -> list[Path]:
    """Return the files on disk that a path refers to: those of the log, also within its folder, if
    the path names a topic; else the file itself. Empty for other folders and for what does not
    exist.
    """
    address = TopicAddress.from_path(path)
    place = Path(path) if address is None else address.log
    if address is not None and place.is_dir():
        return sorted(each for each in place.rglob("*") if each.is_file())
    return [place] if place.is_file() else []


class Log(Protocol):
    """Messages by topic.

    Attributes
    ----------
    topics : dict of name to (type, number of messages)
    start_ns : int
        When the first message was recorded; an integer, as floats lack the precision for present
        dates.
    unit : str or None
        Unit of joint angles ("rad" or "deg") if the format prescribes one.
    """

    topics: dict[str, tuple[str, int]]
    start_ns: int
    unit: str | None

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the time of recording [ns] and the message, whose fields are attributes, of each
        message of a topic.
        """
        ...


@contextmanager
def open_log(path: Path, episode: int | None = None) -> Iterator[Log]:
    """Open a log, whose format is recognised by its ending and its files, for a ``with`` block.

    Parameters
    ----------
    episode : int, optional
        Episode of a dataset, from 0; the only one by default. Ignored for other logs.

    Raises
    ------
    InputError
        If it does not exist, is no log, is damaged, or a package that reads it is missing. Any
        other exception in the ``with`` block, except `ImportError`, is taken for damage.
    """
    if not path.exists():
        raise InputError("there is no such file or folder")
    for each in (path, *(path.iterdir() if path.is_dir() else ())):
        require_regular(each)
    if (path / "meta" / "info.json").is_file():
        log: Any = partial(_Dataset, path, episode)
    elif path.is_file() and path.suffix == ".mcap":
        log = partial(_Mcap, path)
    elif path.suffix in (".bag", ".db3") or (path / "metadata.yaml").is_file():
        log = partial(_Bag, path)
    else:
        raise InputError(
            "this is not a log; expected a ROS bag (a folder with metadata.yaml, .db3 or .bag), "
            "an .mcap file, or a LeRobot dataset (a folder with meta/info.json)"
        )
    try:
        with log() as each:
            yield each
    except (InputError, ImportError):
        raise
    except Exception as error:  # the libraries have exceptions of their own
        raise InputError(
            f"the log is damaged, or a file of another type ({reason(error)}); expected a log that "
            "its own tools can open"
        ) from error


def require_topic(log: Log, topic: str) -> None:
    """Raise an `InputError` with the most similar topic if a log does not have a topic."""
    if topic not in log.topics:
        there = ", ".join(log.topics)
        raise InputError(
            f"there is no topic {topic!r}; expected one of the topics of the log: "
            f"{there}{hint_at(topic, log.topics)}"
        )


def require_packages(*modules: str) -> None:
    """Raise an `InputError` with installation instructions if a package is missing; packages are
    not imported.
    """
    if missing := [module for module in modules if find_spec(module) is None]:
        raise InputError(_NEEDS.format(listed(missing)))


class _Bag:
    """A ROS bag, read through rosbags."""

    unit: str | None = "rad"

    def __init__(self, path: Path) -> None:
        require_packages("rosbags")
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        # Older bags do not contain the definitions of their messages.
        store = get_typestore(Stores.ROS2_HUMBLE)
        self._reader = AnyReader([path], default_typestore=store)

    def __enter__(self) -> Log:
        """Open the bag; return self, with topics and start."""
        self._reader.open()
        self.topics = {
            name: (str(info.msgtype), info.msgcount) for name, info in self._reader.topics.items()
        }
        self.start_ns = self._reader.start_time
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bag."""
        self._reader.close()

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield time of recording [ns] and message, see `Log.messages`."""
        chosen = [each for each in self._reader.connections if each.topic == topic]
        for connection, at_ns, content in self._reader.messages(chosen):
            yield at_ns, self._reader.deserialize(content, connection.msgtype)


class _Mcap:
    """An MCAP file with messages of ROS 2, protobuf or JSON."""

    unit: str | None = "rad"

    def __init__(self, path: Path) -> None:
        require_packages("mcap", "mcap_ros2", "mcap_protobuf")
        self._path = path

    def __enter__(self) -> Log:
        """Open the file; an `InputError` if it has no summary."""
        from mcap.reader import make_reader
        from mcap_protobuf.decoder import DecoderFactory as Protobuf
        from mcap_ros2.decoder import DecoderFactory as Ros2

        self._file = self._path.open("rb")
        decoders: Any = [Ros2(), Protobuf(), _Json()]
        self._reader = make_reader(self._file, decoder_factories=decoders)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise InputError("the log is truncated: it has no summary; `mcap recover` creates one")
        counts = summary.statistics.channel_message_counts
        self.topics = {}
        for key, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            before = self.topics.get(channel.topic, ("", 0))[1]
            kind = schema.name if schema else channel.message_encoding
            self.topics[channel.topic] = kind, before + counts.get(key, 0)
        self.start_ns = summary.statistics.message_start_time
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield time of recording [ns] and message, see `Log.messages`."""
        for _, _, message, content in self._reader.iter_decoded_messages(topics=[topic]):
            yield message.log_time, content


class _Json:
    """Decodes JSON messages of MCAP files."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        """Return the decoder to objects; None for another encoding than "json"."""
        if message_encoding != "json":
            return None
        return partial(json.loads, object_hook=lambda each: SimpleNamespace(**each))


@dataclass
class _Dataset:
    """A LeRobot dataset: its topics are the features, its messages the frames of an episode."""

    path: Path
    episode: int | None = None  # episode to read; None for the only one
    # See `Log`.
    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    start_ns: int = 0
    unit: str | None = None  # not prescribed by the format
    # mapping of topic to list of str: names of the numbers of each feature.
    names: dict[str, list[str]] = field(default_factory=dict)

    def __enter__(self) -> Log:
        """Read the features; indices, timestamps and those without numbers are no topics."""
        require_packages("pyarrow")
        info = json.loads((self.path / "meta" / "info.json").read_text(encoding="utf-8"))
        self._episodes = int(info["total_episodes"])
        for name, feature in info["features"].items():
            if feature["dtype"].startswith(("float", "int")) and "index" not in name:
                self.topics[name] = feature["dtype"], int(info["total_frames"])
                self.names[name] = _component_names(feature, name)
        self.topics.pop("timestamp", None)
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: no file is open."""

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield time [ns] and values of each frame of the episode, as objects with `name` and
        `position` like joint states.

        Raises
        ------
        InputError
            If no episode is stated and there are several, or the episode does not exist.
        """
        from pyarrow import dataset

        if self.episode is None and self._episodes > 1:
            raise InputError(
                f"the dataset has {self._episodes} episodes; expected the index of one of them after "
                f"the topic, as in {self.path.name}#{topic}#0"
            )
        episode = self.episode or 0
        if episode >= self._episodes:
            raise InputError(
                f"found the episode {episode}; expected an index from 0 to {self._episodes - 1}"
            )
        frames = dataset.dataset(self.path / "data", format="parquet").to_table(
            columns=["timestamp", topic], filter=dataset.field("episode_index") == episode
        )
        values: Array = np.asarray(frames[topic].to_pylist(), dtype=float)
        for t_s, each in zip(frames["timestamp"].to_pylist(), values, strict=True):
            yield (
                round(t_s * 1e9),
                SimpleNamespace(name=self.names[topic], position=np.atleast_1d(each)),
            )


def _component_names(feature: Any, name: str) -> list[str]:
    """Return the names of the numbers of a feature; older datasets nest them in a dictionary.

    Without one name for each number they are `name`, or, of several numbers, `name` with _0, _1, ….
    """
    names = feature.get("names")
    while isinstance(names, dict):
        names = next(iter(names.values()), None)
    size = int(np.prod(feature["shape"]))
    if isinstance(names, list) and len(names) == size:
        return [str(each) for each in names]
    return [name] if size == 1 else [f"{name}_{k}" for k in range(size)]
