"""
What is done with hostile messages in a process with limits.

A test file would be imported by each of these processes, with all that it imports.
"""

from dataclasses import replace

import numpy as np

from imu_calibration.core.samples import ImuSamples, JointSamples
from msg_adapters.decode import Decoder, JointDecoder
from msg_adapters.definitions import deserializer
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu, encode_joints


def refusal_of(definition):
    """
    Return the reason why messages of a definition are refused, else ''.

    The reason is 'cannot be read' where a message of 400 bytes is refused.
    """
    try:
        read = deserializer(IMU_TYPE, {IMU_TYPE: ('ros2msg', definition)})
    except ValueError as error:
        return str(error)
    try:
        read(b'\0\1\0\0' + b'\xff' * 400)
    except Exception:
        return 'cannot be read'
    return ''


def decode_long_names(imu):
    """Decode messages of long names; return 0."""
    imu = ImuSamples(imu.stamp_ns, imu.force_s, imu.rate_s)
    messages = [
        encode_imu(replace(imu.select(slice(k, k + 1)), frame_id='x' * (1 << 22) + str(k)))[
            0
        ].tobytes()
        for k in range(4)
    ]
    decoder = Decoder(IMU_TYPE)
    assert decoder.decode(Packed.join(messages)) is None and sum(decoder.dropped.values()) == 4
    names = tuple(f'joint_{k}' for k in range(100_000))
    values = np.zeros((1, len(names)))
    many = encode_joints(JointSamples(np.array([1]), values, values, names))[0].tobytes()
    one = encode_joints(
        JointSamples(np.array([1]), values[:, :1], values[:, :1], ('x' * (1 << 22),))
    )[0].tobytes()
    for data in (many, one):
        decoder = JointDecoder()
        assert (
            decoder.decode(Packed.join([data] * 4)) is None and sum(decoder.dropped.values()) == 4
        )
    return 0
