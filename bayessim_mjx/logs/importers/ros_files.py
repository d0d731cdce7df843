"""MCAP files and ROS bags as messages; the packages that read them are imported here and nowhere else."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.messages import KINDS, Message
from bayessim_mjx.logs.importers.needs import needs


def of_mcap(path: Path) -> Iterator[Message]:
    """Messages of an MCAP file with ROS 2 messages (CDR).

    Raises:
        UserError: the packages are missing, or the file is none.
    """
    reader_of = needs("mcap.reader", "from-mcap", "mcap").make_reader
    decoder = needs("mcap_ros2.decoder", "from-mcap", "mcap-ros2-support").DecoderFactory()
    errors = needs("mcap.exceptions", "from-mcap", "mcap").McapError
    try:
        with path.open("rb") as file:
            reader = reader_of(file, decoder_factories=[decoder])
            summary = reader.get_summary()
            schemas = summary.schemas if summary else {}
            kinds = [(c.topic, _name(schemas.get(c.schema_id))) for c in (summary.channels.values() if summary else ())]
            topics = [topic for topic, kind in kinds if _short(kind) in KINDS]
            yield from (Message(topic, kind, 0, None) for topic, kind in kinds if topic not in topics)
            if summary is not None and not topics:  # an empty list would mean all of them
                return
            for schema, channel, message, body in reader.iter_decoded_messages(topics=topics or None):
                kind, sent = _short(_name(schema)), int(message.publish_time or message.log_time)
                yield Message(channel.topic, kind, sent, body, str(channel.id))
    except (errors, EOFError, struct.error, OSError) as error:
        allowed = "allowed: an .mcap file"
        raise UserError(f"{path}: not a readable MCAP file of ROS 2 messages ({error}); {allowed}") from None


def of_rosbag(path: Path) -> Iterator[Message]:
    """Messages of a ROS 1 bag (a file), or of a ROS 2 bag (a folder).

    Raises:
        UserError: the package is missing, or the bag is none.
    """
    highlevel = needs("rosbags.highlevel", "from-rosbag", "rosbags")
    typesys = needs("rosbags.typesys", "from-rosbag", "rosbags")
    store = typesys.get_typestore(typesys.Stores.LATEST)  # for bags of ROS 2 that do not hold their types
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            known = reader.typestore.fielddefs  # of a bag that does not hold its types, the usual ones
            wanted = [c for c in reader.connections if _short(c.msgtype) in KINDS and c.msgtype in known]
            for c in reader.connections:
                if c not in wanted:
                    yield Message(c.topic, c.msgtype, 0, None)
            for connection, received, raw in reader.messages(connections=wanted) if wanted else ():
                body = reader.deserialize(raw, connection.msgtype)
                sender = str(getattr(connection.ext, "callerid", None) or "")
                yield Message(connection.topic, _short(connection.msgtype), int(received), body, sender)
    except highlevel.AnyReaderError as error:
        raise UserError(
            f"{path}: not a readable ROS bag ({error}); allowed: a .bag file or the folder of a bag"
        ) from None


def _name(schema: Any) -> str:
    return str(schema.name) if schema else ""


def _short(name: str) -> str:
    return name.rpartition("/")[2]
