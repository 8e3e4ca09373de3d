"""Quality of service: inputs as their publishers offer, outputs that any subscriber accepts."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

DEPTH = 1000
"""Messages that wait at most: a pause of 160 ms at 6 kHz, of 5 s at 200 Hz."""


def input_qos(reliable: bool = False, depth: int = DEPTH) -> QoSProfile:
    """Return the profile of an input (`inputs.MatchedInput`): `reliable` repeats lost messages, best effort accepts any publisher."""
    return _last(depth, ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)


def output_qos(depth: int = DEPTH) -> QoSProfile:
    """Return the profile of an output: reliable, so that every subscriber connects."""
    return _last(depth, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def latched_qos() -> QoSProfile:
    """Return the profile of the calibration document: a late subscriber receives the last one."""
    return _last(1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


def _last(depth: int, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)
