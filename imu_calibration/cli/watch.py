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


def _watch(watcher, options):
    """Wait for the node, then show it."""
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
    drawn = out.redraw(watcher.screen(out), 0)
    while time.monotonic() - watcher.heard < GONE:
        watcher.spin(WATCH_PERIOD_SECONDS)
        drawn = out.redraw(watcher.screen(out), drawn)
    if not out.moves:
        out.write(watcher.screen(out))
    out.print(f'{watcher.name} has ended')
    return VerbResult(0, {'node': watcher.name})


def _wait_for_status(watcher, patience):
    """Wait for the first status of the node; name a missing node once."""
    start = time.monotonic()
    named = False
    while not watcher.statuses and time.monotonic() - start < patience:
        watcher.spin(WATCH_PERIOD_SECONDS)
        if not named and time.monotonic() - start > NOTICE_SECONDS and not watcher.statuses:
            named = True
            complain(f"waiting for '{watcher.name}' on /diagnostics{_heard(watcher)}")


def _heard(watcher):
    """Return the names of the received nodes in brackets, '' without any."""
    if not watcher.others:
        return ''
    return f' (heard: {", ".join(sorted(watcher.others))})'


class NodeWatcher:
    """Listens to one node."""

    def __init__(self, context: Any, name: str):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from visualization_msgs.msg import MarkerArray

        self.name = name
        self.statuses = {}
        self.others = set()
        self.picture = ''
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

    def _take(self, array):
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

    def _draw(self, array):
        # The planner adds its own.
        self.picture = next(
            (marker.text for marker in array.markers if marker.ns == 'text'), self.picture
        )

    def spin(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

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
    found = {key.partition(' [')[0]: value for key, value in status.values.items()}
    try:
        return float(found['standard error']) / float(found['tolerance'])
    except (KeyError, ValueError, ZeroDivisionError):
        return math.nan


def bar(ratio: float, width: int = BAR) -> str:
    """Return a bar that shrinks with the uncertainty of a parameter; ``|`` marks its tolerance."""
    tick = round(width * math.log(1 / EMPTY_RATIO) / math.log(FULL_RATIO / EMPTY_RATIO))
    if math.isnan(ratio):
        return ' ' * tick + '|' + '?' * (width - tick - 1)
    filled = round(
        width
        * min(
            max(
                math.log(max(ratio, EMPTY_RATIO) / EMPTY_RATIO)
                / math.log(FULL_RATIO / EMPTY_RATIO),
                0.0,
            ),
            1.0,
        )
    )
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
    for title, name in (
        ('streams', 'streams'),
        ('verdict', 'calibration'),
        ('finding', 'diagnosis'),
    ):
        if name in statuses:
            status = statuses[name]
            lines += out.table(
                [
                    (
                        (title, 'dim'),
                        (status.message.partition('; ')[0], STYLES[LEVELS[min(status.level, 2)]]),
                    )
                ]
            )
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
    return lines + (out.table([(('next', 'dim'), (picture, 'bold'))]) if picture else [])
