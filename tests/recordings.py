"""Reads recordings by the MCAP library, as other programs do."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def messages(path: Path) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield topic, schema, message and content of every message of a recording."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                yield channel.topic, schema.name, message, json.loads(message.data)
            else:
                decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
                yield channel.topic, schema.name, message, decoder(message.data)
