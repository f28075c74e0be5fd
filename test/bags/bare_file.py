# SPDX-License-Identifier: Apache-2.0
"""Bare mcap files with one message, valid or with a single error."""

import struct

from mcap.writer import Writer

from musculoskeletal_ae.bags.message_types import definition

FLOAT = 'std_msgs/msg/Float64'
ONE = b'\x00\x01\x00\x00' + struct.pack('<d', 1.0)


def write(
    path, schema=FLOAT, text=None, topic='/anomaly', data=ONE, profile='ros2', file=(), **channel
):
    """Write an mcap file with one message, by default a valid one on /anomaly; return its path."""
    with path.open('wb') as stream:
        writer = Writer(stream, **({'enable_data_crcs': True} | dict(file)))
        writer.start(profile=profile)
        text = definition(FLOAT) if text is None else text
        number = writer.register_schema(schema, channel.pop('encoding', 'ros2msg'), text.encode())
        options = {'message_encoding': 'cdr', **channel}
        number = writer.register_channel(topic, schema_id=number, **options)
        writer.add_message(number, 5, data, 4)
        writer.finish()
    return path
