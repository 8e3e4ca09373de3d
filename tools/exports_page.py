"""The page of the formats of other programs, written from the targets: ``make answers``."""

from pathlib import Path

from imu_calibration.document.exports.export import all_targets, holds_in_words
from imu_calibration.document.exports.target import Target

HEAD = """\
# Into other programs, and back

`imu_calibration export` writes these formats, `imu_calibration import` reads them; `make answers`
writes this page ([decision](decisions/exports.md)). N is the density of white noise, K that of the
random walk, in continuous time as in noise.yaml; `rate` is the sampling rate of the program.

Effects that a program cannot hold are lost: file and terminal state each with its size in the
readings and the remaining error, measured with the formula below on the given recording or a
standard motion. Tests apply the same formulas, written again from the sources, to random
calibrations.

| name | format | held parts of the calibration | estimated by the program | noise | import |
| --- | --- | --- | --- | --- | --- |
"""


def rendered() -> str:
    """Return the text of the page."""
    targets = all_targets().values()
    return HEAD + ''.join(map(_row, targets)) + '\n' + '\n'.join(map(_section, targets))


def _row(target: Target) -> str:
    sensors = {capability.sensor for capability in target.estimates}
    estimated = (
        'biases' + (f' ({", ".join(sensors)})' if len(sensors) == 1 else '') if sensors else '-'
    )
    cells = (
        f'`{target.name}`',
        target.title,
        holds_in_words(target),
        estimated,
        target.noise_is or '-',
        'yes' if target.read else 'no',
    )
    return f'| {" | ".join(cells)} |\n'


def _section(target: Target) -> str:
    hint = f'{target.hint[0].upper()}{target.hint[1:]}.\n' if target.hint else ''
    return (
        f'## {target.name}\n\n```\n{target.formula}\n```\n\n'
        + f'Source: {target.source}. {hint}'.rstrip()
        + '\n'
    )


def main(folder: Path = Path(__file__).resolve().parents[1] / 'docs') -> None:
    """Write the page."""
    (folder / 'exports.md').write_text(rendered())


if __name__ == '__main__':
    main()
