"""Bags whose topics have the names of a vehicle's drivers."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from rosbags.rosbag2 import Reader

from subiaco_geo.bags import BagMessage, BagReader, TopicInfo
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS, types_of
from subiaco_mapping.topic_names import TopicsConfig


class NamedBagReader(BagReader):
    """Read a bag under our names.

    Parameters
    ----------
    path : Path
    names : mapping of str to str
        The bag's name to ours; it wins over a topic that has our name already.
    """

    def __init__(self, path: Path, names: Mapping[str, str]) -> None:
        super().__init__(path)
        self._names = dict(names)
        self._theirs: dict[str, str] = {}

    def _read_summary(self, reader: Reader) -> None:
        super()._read_summary(reader)
        self._theirs = {ours: theirs for theirs, ours in self._names.items() if theirs in self.topics}
        plain = {name: info for name, info in self.topics.items() if name not in self._theirs.values()}
        self.topics = plain | {ours: self.topics[theirs] for ours, theirs in self._theirs.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield messages of our names, in log-time order."""
        wanted = self.topics.keys() if topics is None else topics
        back = {theirs: ours for ours, theirs in self._theirs.items()}
        for message in super().messages({self._theirs.get(name, name) for name in wanted}):
            ours = back.get(message.topic)
            yield message if ours is None else replace(message, topic=ours)


def open_bag(path: Path, topics: TopicsConfig) -> BagReader:
    """Return a reader that gives the topics of a configuration their names of ours."""
    names = topics.bag_names()
    return NamedBagReader(path, names) if names else BagReader(path)


def guess_names(topics: Mapping[str, TopicInfo], config: TopicsConfig) -> dict[str, str]:
    """Guess which of a bag's topics stand for ours that are missing, by their types.

    Parameters
    ----------
    topics : mapping of str to TopicInfo
        Of the bag, by its own names.
    config : TopicsConfig
        What is configured is not guessed.

    Returns
    -------
    dict
        The bag's name to ours; one candidate of a type is taken, of several the one with most messages.
    """
    given = {ours for ours, _ in config.remappings()}
    found: dict[str, str] = {}
    for ours in (LIDAR_PACKETS, METADATA, POINTS, IMU, FIX):
        if (
            ours in topics
            or ours in given
            or (ours == POINTS and LIDAR_PACKETS in {*topics, *found.values()})
        ):
            continue
        fitting = [name for name, info in topics.items() if _fits(name, info, ours) and name not in found]
        if fitting:
            found[max(fitting, key=lambda name: topics[name].count)] = ours
    return found


def _fits(name: str, info: TopicInfo, ours: str) -> bool:
    if info.msg_type not in types_of(ours) or name in MESSAGE_TYPES:
        return False
    word = {METADATA: "metadata", LIDAR_PACKETS: "lidar"}.get(ours, "")
    return word in name.lower() and not (ours == IMU and "heading" in name.lower())
