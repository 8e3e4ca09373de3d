"""Screen of `imu_calibration watch`, made from the session's statuses on /diagnostics."""

import math
from dataclasses import dataclass, field
from typing import Any

BAR = 26
"""Characters of a bar."""
MOST = 1000.0
"""Times the tolerance at which a bar is full; it is logarithmic."""
LEAST = 0.1
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
    """Return the standard deviation of a parameter group in units of its tolerance, NaN before there is one."""
    found = {key.partition(' [')[0]: value for key, value in status.values.items()}
    try:
        return float(found['standard error']) / float(found['tolerance'])
    except (KeyError, ValueError, ZeroDivisionError):
        return math.nan


def bar(ratio: float, width: int = BAR) -> str:
    """Return a bar that shrinks with the uncertainty of a parameter; ``|`` marks its tolerance."""
    tick = round(width * math.log(1 / LEAST) / math.log(MOST / LEAST))
    if math.isnan(ratio):
        return ' ' * tick + '|' + '?' * (width - tick - 1)
    filled = round(width * min(max(math.log(max(ratio, LEAST) / LEAST) / math.log(MOST / LEAST), 0.0), 1.0))
    cells = ['#' if k < filled else ' ' for k in range(width)]
    cells[min(tick, width - 1)] = '|'
    return ''.join(cells)


def screen(node: str, statuses: dict[str, NodeStatus], picture: str) -> Any:
    """
    Return the screen, for a console of rich.

    Parameters
    ----------
    node : str
        Name of the watched node.
    statuses : dict
        Name of the status, without the node's -> NodeStatus.
    picture : str
        The text line of the sphere of imu/coverage; '' without one.

    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from imu_calibration.cli.show import STYLES
    groups = {name: status for name, status in statuses.items() if name not in NOT_GROUPS}
    table = Table(box=None, pad_edge=False, show_header=True, header_style='dim')
    table.add_column('parameters', no_wrap=True)
    table.add_column(f'{"":{round(BAR / 4)}}| determined', no_wrap=True)
    table.add_column('x tolerance', justify='right', no_wrap=True)
    for name, status in groups.items():
        ratio = ratio_of(status)
        style = 'dim' if math.isnan(ratio) else 'green' if ratio <= 1 else 'yellow'
        table.add_row(name.replace('accelerometer', 'accel.').replace('gyroscope', 'gyro.'), Text(bar(ratio), style),
                      '-' if math.isnan(ratio) else f'{ratio:.2g}')
    lines: list[Any] = [Text(node, 'bold')]
    for title, name in (('streams', 'streams'), ('verdict', 'calibration'), ('finding', 'diagnosis')):
        if name in statuses:
            status = statuses[name]
            lines.append(Text.assemble((f'{title}  ', 'dim'), (status.message.partition('; ')[0], STYLES[LEVELS[min(status.level, 2)]])))
    lines += [table] * bool(groups)
    lines += [Text.assemble(('next  ', 'dim'), (picture, 'bold'))] * bool(picture)
    return Group(*lines)
