"""``imu_calibration watch``: a running calibration_node in the terminal."""

import math
import time
from dataclasses import asdict, dataclass, field
from typing import Any

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, complain
from imu_calibration.cli.terminal import STYLES, Cell, Terminal
from imu_calibration.core.errors import InputError, printable

EXAMPLES = ('', '--node /lab/calibration_node --once')
GONE = 5.0
"""Seconds without a message after which the node counts as ended."""
WATCH_PERIOD_SECONDS = 0.25
"""Time between two screens."""
ONCE_SECONDS = 10.0
"""
Default patience where one status is wanted; also the longest wait for a complete screen where the
patience has no limit.
"""
NOTICE_SECONDS = 3.0
"""Seconds of waiting after which the missing node is named."""


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.common(
        '--node',
        metavar='NAME',
        default='calibration_node',
        help='full name of the node, default calibration_node',
    )
    parser.common(
        '--patience',
        metavar='SECONDS',
        type=float,
        help='how long to wait for it, default without an end; with --once or --json 10',
    )
    parser.common('--once', action='store_true', help='show the present status and end')


def run(options: Options) -> VerbResult:
    """Show the status of the node until it ends."""
    try:
        import rclpy
    except ImportError as error:
        raise InputError(
            'to watch a node rclpy must be installed, it is not; source ROS, or install'
            ' ros-jazzy-rclpy'
        ) from error
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException

    context = Context()
    rclpy.init(context=context)
    try:
        return _watch(NodeWatcher(context, options.node.strip('/')), options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return VerbResult(130)
    finally:
        context.try_shutdown()


def _watch(watcher: 'NodeWatcher', options: Options) -> VerbResult:
    """Wait for the node, then show its screen until it ends, or once."""
    patience = options.patience
    if patience is None:
        patience = math.inf
        if options.once or options.json:
            patience = ONCE_SECONDS
    _wait_for_status(watcher, patience)
    if not watcher.statuses:
        raise InputError(
            f"'{options.node}' must run, no message on /diagnostics in {patience:g} s;"
            f' start it, or name it with --node, as `ros2 node list` shows it{_heard(watcher)}'
        )
    # Wait for the line of the streams, which the first message of a node does not contain, and for
    # the picture, which is latched: a node that publishes it sends it at once.
    end = time.monotonic() + (patience if patience < math.inf else ONCE_SECONDS)
    while not watcher.complete and time.monotonic() < end:
        watcher.spin(WATCH_PERIOD_SECONDS)
    out = Terminal.of()
    if options.once or options.json:
        out.write(watcher.screen(out))
        return VerbResult(
            0,
            {
                'node': watcher.name,
                'status': {name: asdict(status) for name, status in watcher.statuses.items()},
            },
        )
    n_drawn = out.redraw(watcher.screen(out), 0)
    while time.monotonic() - watcher.heard < GONE:
        watcher.spin(WATCH_PERIOD_SECONDS)
        n_drawn = out.redraw(watcher.screen(out), n_drawn)
    if not out.moves:
        out.write(watcher.screen(out))
    out.print(f'{watcher.name} has ended')
    return VerbResult(0, {'node': watcher.name})


def _wait_for_status(watcher: 'NodeWatcher', patience: float) -> None:
    """Wait up to `patience` seconds for the first status of the node; name a missing node once."""
    start = time.monotonic()
    is_named = False
    while not watcher.statuses and time.monotonic() - start < patience:
        watcher.spin(WATCH_PERIOD_SECONDS)
        if not is_named and time.monotonic() - start > NOTICE_SECONDS and not watcher.statuses:
            is_named = True
            complain(f"waiting for '{watcher.name}' on /diagnostics{_heard(watcher)}")


def _heard(watcher: 'NodeWatcher') -> str:
    """Return in brackets the names of the nodes whose status was received, '' without any."""
    if not watcher.others:
        return ''
    return f' (heard: {", ".join(sorted(watcher.others))})'


class NodeWatcher:
    """Receives the status of one node, and its picture of the coverage."""

    def __init__(self, context: Any, name: str) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from visualization_msgs.msg import MarkerArray

        self.name = name
        # Name of a status, without the node's -> its last value.
        self.statuses: dict[str, NodeStatus] = {}
        # Names of further nodes that publish a status.
        self.others: set[str] = set()
        # Text line of the sphere of imu/coverage.
        self.picture = ''
        # Time of the last status of the node, s.
        self.heard = time.monotonic()
        self._node = rclpy.create_node('imu_calibration_watch', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._take, 100)
        topic = '/' + '/'.join([*name.split('/')[:-1], 'imu/coverage'])
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._node.create_subscription(MarkerArray, topic, self._draw, latched)

    @property
    def complete(self) -> bool:
        """Whether every part of the screen was received."""
        return 'streams' in self.statuses and bool(self.picture)

    def _take(self, array: Any) -> None:
        """Store the statuses of a DiagnosticArray."""
        for status in array.status:
            node, _, name = status.name.partition(': ')
            if node == self.name:
                values = {printable(pair.key): printable(pair.value) for pair in status.values}
                self.statuses[printable(name)] = NodeStatus(
                    status.level[0], printable(status.message), values
                )
                self.heard = time.monotonic()
            else:
                self.others.add(printable(node))

    def _draw(self, array: Any) -> None:
        """Store the text line of a MarkerArray; markers of the planner have none."""
        for marker in array.markers:
            if marker.ns == 'text':
                self.picture = marker.text
                break

    def spin(self, seconds: float) -> None:
        """Receive messages for this time."""
        end = time.monotonic() + seconds
        remaining = seconds
        while remaining > 0:
            self._executor.spin_once(timeout_sec=remaining)
            remaining = end - time.monotonic()

    def screen(self, out: Terminal) -> list[str]:
        """Return the lines of the present screen."""
        return screen(self.name, self.statuses, self.picture, out=out)


BAR = 26
"""Characters of a bar."""
FULL_RATIO = 1000.0
"""Times the tolerance at which a bar is full; it is logarithmic."""
EMPTY_RATIO = 0.1
"""Times the tolerance at which it is empty."""
LEVELS = ('good', 'warning', 'refuse')
"""Key of `STYLES` of each `NodeStatus.level`."""
NOT_GROUPS = ('streams', 'calibration', 'poses', 'diagnosis', 'diagnostics', 'planner')


@dataclass(frozen=True)
class NodeStatus:
    """One DiagnosticStatus."""

    level: int
    """0 OK, 1 WARN, 2 ERROR."""
    message: str
    """One line."""
    values: dict[str, str] = field(default_factory=dict)
    """Further figures."""


def ratio_of(status: NodeStatus) -> float:
    """
    Return the standard deviation of a parameter group in units of its tolerance.

    It is NaN before there is one.
    """
    # Keys end in their unit, as 'tolerance [m/s^2]'.
    texts = {key.partition(' [')[0]: text for key, text in status.values.items()}
    try:
        return float(texts['standard error']) / float(texts['tolerance'])
    except (KeyError, ValueError, ZeroDivisionError):
        return math.nan


def bar(ratio: float, width: int = BAR) -> str:
    """
    Return a bar that shrinks with the uncertainty of a parameter; ``|`` marks its tolerance.

    Its share of the width is ``ln(ratio / EMPTY_RATIO) / ln(FULL_RATIO / EMPTY_RATIO)``, with the
    uncertainty in tolerances (`ratio`); question marks where that is NaN.
    """
    span = math.log(FULL_RATIO / EMPTY_RATIO)
    tick = round(width * math.log(1 / EMPTY_RATIO) / span)
    if math.isnan(ratio):
        return ' ' * tick + '|' + '?' * (width - tick - 1)
    share = math.log(max(ratio, EMPTY_RATIO) / EMPTY_RATIO) / span
    filled = round(width * min(max(share, 0.0), 1.0))
    cells = ['#' if k < filled else ' ' for k in range(width)]
    cells[min(tick, width - 1)] = '|'
    return ''.join(cells)


def screen(node: str, statuses: dict[str, NodeStatus], picture: str, *, out: Terminal) -> list[str]:
    """
    Return the lines of the screen.

    Parameters
    ----------
    node : str
        Name of the watched node.
    statuses : dict
        Name of the status, without the node's -> NodeStatus.
    picture : str
        The text line of the sphere of imu/coverage; '' without one.
    out : Terminal

    """
    lines = [out.styled(node, 'bold')]
    titles = {'streams': 'streams', 'calibration': 'verdict', 'diagnosis': 'finding'}
    for name, title in titles.items():
        if name in statuses:
            status = statuses[name]
            message, _, _ = status.message.partition('; ')
            style = STYLES[LEVELS[min(status.level, 2)]]
            lines += out.table([((title, 'dim'), (message, style))])
    rows: list[list[Cell]] = []
    for name, status in statuses.items():
        if name not in NOT_GROUPS:
            ratio = ratio_of(status)
            short = name.replace('accelerometer', 'accel.').replace('gyroscope', 'gyro.')
            if math.isnan(ratio):
                rows.append([short, (bar(ratio), 'dim'), '-'])
            else:
                style = 'green' if ratio <= 1 else 'yellow'
                rows.append([short, (bar(ratio), style), f'{ratio:.2g}'])
    if rows:
        headings = ('parameters', f'{"":{round(BAR / 4)}}| determined', 'x tolerance')
        lines += out.table([[(heading, 'dim') for heading in headings], *rows], right=[2])
    if picture:
        lines += out.table([(('next', 'dim'), (picture, 'bold'))])
    return lines
