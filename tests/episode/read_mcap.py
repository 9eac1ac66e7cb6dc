"""Reads an exported episode with the Python packages `mcap` and `mcap-protobuf-support`, and prints what is in it.

    pip install mcap mcap-protobuf-support
    wildcity episode export EPISODE --mcap episode.mcap && python tests/episode/read_mcap.py episode.mcap

Every CRC is checked and every message is decoded by the schema that is in the file. A damaged copy of the file must be
noticed.
"""

import collections
import io
import json
import sys

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def count(data: bytes) -> collections.Counter:
    found: collections.Counter = collections.Counter()
    before_ns = 0
    reader = make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])
    for schema, channel, message in reader.iter_messages():
        assert message.log_time >= before_ns, "messages are in order of their times"
        before_ns = message.log_time
        if schema.encoding == "jsonschema":
            json.loads(schema.data)
            json.loads(message.data)
        found[f"{channel.topic} {schema.name}"] += 1
    decoded = collections.Counter()
    reader = make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])
    topics = [topic for topic in {key.split()[0] for key in found} if not topic.startswith("/wildcity")]
    for _, channel, _, message in reader.iter_decoded_messages(topics=topics):
        assert message.ListFields(), f"{channel.topic}: an empty message"
        decoded[channel.topic] += 1
    assert sum(decoded.values()) == sum(n for key, n in found.items() if not key.startswith("/wildcity"))
    return found


def main() -> None:
    with open(sys.argv[1], "rb") as file:
        data = file.read()
    for key, messages in sorted(count(data).items()):
        print(f"{messages:6} {key}")
    print(f"{len(data)} bytes")
    damaged = bytearray(data)
    damaged[len(data) // 3] ^= 0x40
    try:
        count(bytes(damaged))
    except Exception as error:
        print(f"damaged: {type(error).__name__}: {error}")
    else:
        sys.exit("a damaged file was read")


main()
