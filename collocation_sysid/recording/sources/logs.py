"""Logs of robots: ROS 1 and 2 bags, MCAP files, and LeRobot datasets.

In place of a file, a topic of a log may be given, as in ``run.mcap#/force``; it is read as the
table that `topics` makes of its messages. Further parts follow after a ``#`` each: two frames, as
in ``run.mcap#/tf#base>tool``, a robot's description, and the episode of a dataset.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import reason, require_regular
from ...common.text_files import parse_json, read_text
from ...errors import InputError, hint_at, listed
from .messages import measurement_time_s

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


@dataclass(frozen=True)
class Log:
    """Messages by topic."""

    topics: dict[str, tuple[str, int]]  # type and number of messages by name
    # When the first message was recorded; an integer, as floats lack the precision for present
    # dates.
    start_ns: int
    # Yields the time of recording [ns] and the message, whose fields are attributes, of each message
    # of a topic.
    decoded: Callable[[str], Iterable[tuple[int, Any]]]
    unit: str | None = "rad"  # unit of joint angles; None if the format prescribes none

    def messages(self, topic: str) -> Iterable[tuple[int, Any]]:
        """Return the times of recording [ns] and the messages of a topic; an `InputError` with the
        most similar topic if the log does not have it.
        """
        if topic not in self.topics:
            there = ", ".join(self.topics)
            raise InputError(
                f"there is no topic {topic!r}; expected one of the topics of the log: "
                f"{there}{hint_at(topic, self.topics)}"
            )
        return self.decoded(topic)

    def first(self, topic: str) -> Any:
        """Return the first message of a topic; None if there is none."""
        return next((message for _, message in self.messages(topic)), None)

    def read(self, topic: str) -> tuple[Array, list[Any]]:
        """Return the times (S,) [s] of the messages of a topic, ascending, see `measurement_time_s`,
        and the messages in this order; of messages with the same time the first is kept.

        Raises
        ------
        InputError
            If all have the same time, but were recorded at different times.
        """
        messages = list(self.messages(topic))
        t_s = [measurement_time_s(each, at_ns, self.start_ns) for at_ns, each in messages]
        if len({*t_s}) == 1 < len({at_ns for at_ns, _ in messages}):
            raise InputError(
                f"all {len(messages)} messages of the topic {topic} have the same stamp, but were "
                "recorded at different times; expected stamps that advance: set all stamps of the "
                "topic to zero, for which the times of recording are used, or convert it to a table "
                "with these times"
            )
        times, first = np.unique(t_s, return_index=True)
        return times, [messages[k][1] for k in first]


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
        log = _dataset(path, episode)
    elif path.is_file() and path.suffix == ".mcap":
        log = _mcap(path)
    elif path.suffix in (".bag", ".db3") or (path / "metadata.yaml").is_file():
        log = _bag(path)
    else:
        raise InputError(
            "this is not a log; expected a ROS bag (a folder with metadata.yaml, .db3 or .bag), "
            "an .mcap file, or a LeRobot dataset (a folder with meta/info.json)"
        )
    try:
        with log as opened:
            yield opened
    except (InputError, ImportError):
        raise
    except Exception as error:  # the libraries have exceptions of their own
        raise InputError(
            f"the log is damaged, or a file of another type ({reason(error)}); expected a log that "
            "its own tools can open"
        ) from error


def require_packages(*modules: str) -> None:
    """Raise an `InputError` with installation instructions if a package is missing; packages are
    not imported.
    """
    if missing := [module for module in modules if find_spec(module) is None]:
        raise InputError(_NEEDS.format(listed(missing)))


@contextmanager
def _bag(path: Path) -> Iterator[Log]:
    require_packages("rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Older bags do not contain the definitions of their messages.
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:

        def decoded(topic: str) -> Iterator[tuple[int, Any]]:
            chosen = [each for each in reader.connections if each.topic == topic]
            for connection, at_ns, content in reader.messages(chosen):
                yield at_ns, reader.deserialize(content, connection.msgtype)

        topics = {name: (str(info.msgtype), info.msgcount) for name, info in reader.topics.items()}
        yield Log(topics, reader.start_time, decoded)


@contextmanager
def _mcap(path: Path) -> Iterator[Log]:
    require_packages("mcap", "mcap_ros2", "mcap_protobuf")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory as Protobuf
    from mcap_ros2.decoder import DecoderFactory as Ros2

    with path.open("rb") as file:
        silent = SimpleNamespace(decoder_for=partial(_silenced, Ros2().decoder_for))
        decoders: Any = [silent, Protobuf(), _Json()]
        reader = make_reader(file, decoder_factories=decoders)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise InputError("the log is truncated: it has no summary; `mcap recover` creates one")
        counts = summary.statistics.channel_message_counts
        topics: dict[str, tuple[str, int]] = {}
        for key, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            before = topics.get(channel.topic, ("", 0))[1]
            kind = schema.name if schema else channel.message_encoding
            topics[channel.topic] = kind, before + counts.get(key, 0)

        def decoded(topic: str) -> Iterator[tuple[int, Any]]:
            for _, _, message, content in reader.iter_decoded_messages(topics=[topic]):
                yield message.log_time, content

        yield Log(topics, summary.statistics.message_start_time, decoded)


def _silenced(call: Callable[..., Any], *words: Any) -> Any:
    """The library prints the definitions of messages that it does not understand."""
    with redirect_stderr(io.StringIO()):
        return call(*words)


class _Json:
    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        """Return the decoder to objects; None for another encoding than "json"."""
        if message_encoding != "json":
            return None
        return partial(json.loads, object_hook=lambda each: SimpleNamespace(**each))


@contextmanager
def _dataset(path: Path, episode: int | None) -> Iterator[Log]:
    """The topics are the features, the messages the frames of an episode, like joint states."""
    require_packages("pyarrow")
    info = parse_json(read_text(path / "meta" / "info.json", "the list of features of a dataset"))
    features = {
        name: feature
        for name, feature in info["features"].items()
        if feature["dtype"].startswith(("float", "int"))
        and "index" not in name
        and name != "timestamp"
    }
    episodes = int(info["total_episodes"])

    def decoded(topic: str) -> Iterator[tuple[int, Any]]:
        from pyarrow import dataset

        if episode is None and episodes > 1:
            raise InputError(
                f"the dataset has {episodes} episodes; expected the index of one of them after "
                f"the topic, as in {path.name}#{topic}#0"
            )
        if (index := episode or 0) >= episodes:
            raise InputError(
                f"found the episode {index}; expected an index from 0 to {episodes - 1}"
            )
        frames = dataset.dataset(path / "data", format="parquet").to_table(
            columns=["timestamp", topic], filter=dataset.field("episode_index") == index
        )
        names = _component_names(features[topic], topic)
        values: Array = np.asarray(frames[topic].to_pylist(), dtype=float)
        for t_s, each in zip(frames["timestamp"].to_pylist(), values, strict=True):
            yield round(t_s * 1e9), SimpleNamespace(name=names, position=np.atleast_1d(each))

    count = int(info["total_frames"])
    topics = {name: (feature["dtype"], count) for name, feature in features.items()}
    yield Log(topics, 0, decoded, unit=None)


def _component_names(feature: Any, name: str) -> list[str]:
    """Return the names of the numbers of a feature; older datasets nest them in a dictionary."""
    names = feature.get("names")
    while isinstance(names, dict):
        names = next(iter(names.values()), None)
    size = int(np.prod(feature["shape"]))
    if isinstance(names, list) and len(names) == size:
        return [str(each) for each in names]
    return [name] if size == 1 else [f"{name}_{k}" for k in range(size)]
