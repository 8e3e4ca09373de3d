"""
The parameter files of the nodes, written from the declarations of their settings: ``make config``.
"""

import textwrap
from pathlib import Path

from imu_calibration.core.settings import describe
from imu_calibration.nodes import NODE_NAMES
from imu_calibration.nodes.lifecycle import meaning, settings_of, value_text


def main(folder: Path = Path(__file__).resolve().parents[1] / 'config') -> None:
    """Write one file for each node, and print which have changed."""
    for node in NODE_NAMES:
        path = folder / f'{node}.yaml'
        text = rendered(node)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
            print(f'written: {path}')


def rendered(node: str) -> str:
    """Return the text of the parameter file of `node`."""
    lines = [
        (
            f'# Parameters of {node} with their defaults: meaning [unit], range, and symptoms of a'
            ' wrong value.'
        ),
        '/**:',
        '  ros__parameters:',
    ]
    for group in settings_of(node):
        for item in describe(group):
            words = meaning(item) + (f'. When wrong: {item.symptom}' if item.symptom else '')
            lines += textwrap.wrap(words, 120, initial_indent='    # ', subsequent_indent='    # ')
            lines.append(
                f'    {"# " if item.session else ""}{item.name}: {value_text(item.default)}'
            )
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    main()
