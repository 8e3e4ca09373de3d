"""
The file of tolerances that users copy and change, written from the catalogue: ``make config``.
"""

from pathlib import Path

from imu_calibration.effects.base import SECTIONS
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue

HEAD = """\
# Standard deviation up to which a parameter counts as determined; above it the parameter is called
# weak. One number per effect, SI, for each of its components. Copy this file, change what your use
# needs, and pass it on: the option tolerances of the command line, the parameter tolerances_file of
# calibration_node.
# The reasons refer to navigation with a MEMS or tactical IMU on a robot.
"""
COMMENT_AT = 35
"""Column at which the reasons begin."""


def rendered(catalogue: Catalogue = CATALOGUE) -> str:
    """
    Return the text of the file.

    Every effect's tolerance as it is declared, with its unit and reason.
    """
    lines = [HEAD]
    for section in SECTIONS:
        effects = [effect for effect in catalogue.effects().values() if effect.sensor == section]
        lines += [
            f'{section}:',
            *(
                f'{f"  {e.name}: {_number(e.tolerance)}":{COMMENT_AT - 1}} # {e.unit_of(0)}:'
                f' {e.tolerance_reason}'
                for e in effects
            ),
            '',
        ]
    return '\n'.join(lines[:-1]) + '\n'


def _number(value):
    """Return a number so that YAML reads a number."""
    mantissa, exponent = f'{value:.5e}'.split('e')
    mantissa = mantissa.rstrip('0')
    return (
        f'{mantissa}0e{int(exponent)}' if mantissa.endswith('.') else f'{mantissa}e{int(exponent)}'
    )


def main(folder: Path = Path(__file__).resolve().parents[1] / 'config') -> None:
    """Write the file, and report whether it has changed."""
    path = folder / 'tolerances.yaml'
    if not path.exists() or path.read_text() != rendered():
        path.write_text(rendered())
        print(f'written: {path}')


if __name__ == '__main__':
    main()
