"""Reads MCAP files with the official library and prints, as JSON, what they hold.

usage: check_mcap.py FILE...

The output is a list with an object per file: messages per topic by the index, and for every decoded message of the
topics `/observation`, `/action` and `/step` the values of its fields, in the order of the log. CRCs are checked.
Needs mcap and mcap-protobuf-support.
"""

import json
import sys

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

TOPICS = ["/observation", "/action", "/step"]


def value(field):
    """A field as JSON: repeated fields are lists."""
    return list(field) if hasattr(field, "__len__") and not isinstance(field, (str, bytes)) else field


def describe(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        counts = summary.statistics.channel_message_counts
        topics = {channel.topic: counts.get(number, 0) for number, channel in summary.channels.items()}
        messages = {topic: [] for topic in TOPICS}
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=TOPICS):
            fields = {field.name: value(item) for field, item in decoded.ListFields()}
            messages[channel.topic].append({"log_time": message.log_time, **fields})
    return {"topics": topics, "messages": messages}


json.dump([describe(path) for path in sys.argv[1:]], sys.stdout)
