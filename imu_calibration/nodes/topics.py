"""The first line that a node prints: the topics that it reads and publishes, after remapping."""

from collections.abc import Sequence

from rclpy.node import Node


def announce(node: Node, inputs: Sequence[str], outputs: Sequence[str], *, note: str = '') -> None:
    """Log the full names of topics, given as relative names, and a note."""
    read, published = (', '.join(map(node.resolve_topic_name, names)) or 'nothing' for names in (inputs, outputs))
    node.get_logger().info(f'reads {read}; publishes {published}' + (f'; {note}' if note else ''))
