"""docs/exports.md, written from the records of the targets: ``make answers``."""

from pathlib import Path

from imu_calibration.exports.export import holds_in_words
from imu_calibration.exports.registry import all_targets
from imu_calibration.exports.target import Target

HEAD = """\
# Into other programs, and back

Written by `make answers` from the records in `imu_calibration/exports/targets/`, one a program; why they are as they are stands in
[decisions/exports.md](decisions/exports.md). `imu_calibration export` writes, `imu_calibration import` reads. N is the density of white
noise, K that of the random walk, both in continuous time as in noise.yaml; `rate` is the rate at which the program gets the readings.

What a program cannot hold is lost: the effect, what it makes in the readings, and the error that remains once the program has used all
it has, stand in each file and on the terminal. The error is measured with the formula below on the recording that is given, or on a
standard motion. The tests apply the same formulas, written a second time from the sources named here, to random calibrations: they give
our compensation to 1e-12 where nothing is lost and the announced error elsewhere.

| name | what it is | of the calibration it holds | it estimates by itself | noise | can be read back |
| --- | --- | --- | --- | --- | --- |
"""


def rendered() -> str:
    """Return the text of the page."""
    targets = all_targets().values()
    return HEAD + ''.join(map(_row, targets)) + '\n' + '\n'.join(map(_section, targets))


def _row(target: Target) -> str:
    sensors = {holding.sensor for holding in target.estimates}
    estimated = 'biases' + (f' ({", ".join(sensors)})' if len(sensors) == 1 else '') if sensors else '-'
    cells = (f'`{target.name}`', target.title, holds_in_words(target), estimated, target.noise_is or '-', 'yes' if target.read else 'no')
    return f'| {" | ".join(cells)} |\n'


def _section(target: Target) -> str:
    hint = f'{target.hint[0].upper()}{target.hint[1:]}.\n' if target.hint else ''
    return f'## {target.name}\n\n```\n{target.formula}\n```\n\nSource: {target.source}. {hint}'.rstrip() + '\n'


def main(folder: Path = Path(__file__).resolve().parents[2] / 'docs') -> None:
    """Write the page."""
    (folder / 'exports.md').write_text(rendered())


if __name__ == '__main__':
    main()
