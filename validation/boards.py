"""The arm between IMUs on one board, from two recordings, against the design."""

from itertools import combinations

import numpy as np

from imu_calibration.between_imus.arm import estimate_arm
from validation.figures import new_figure
from validation.recordings import BOARD, load, reference
from validation.section import Section, listed, text

NAMES = ('array_2', 'array_5')


def arms_of(folder, name, pairs):
    """Return {(a, b): RelativeArm} of one recording."""
    imus = {
        k: load(folder, name, f'/imu_{k}/data_raw')
        for k in sorted({k for pair in pairs for k in pair})
    }
    return {(a, b): estimate_arm(imus[a], imus[b]) for a, b in pairs}


def design_mm(folder, name, pair):
    """Return the designed arm from the first IMU of a pair to the second, mm."""
    positions = reference(folder, name)['positions']
    return 1e3 * (np.array(positions[f'imu_{pair[1]}']) - positions[f'imu_{pair[0]}'])


def run(folder, plots):
    """Return the section."""
    section = Section('Arms between IMUs on one board (array_2, array_5)')
    pairs = list(combinations(BOARD, 2))
    arms = {name: arms_of(folder, name, pairs) for name in NAMES}

    # Errors of the arms in each recording, mm, shape (n_pairs, 3).
    errors = {}
    for name in NAMES:
        errors[name] = np.array(
            [1e3 * arms[name][pair].arm - design_mm(folder, name, pair) for pair in pairs]
        )
    worst = max(np.max(np.linalg.norm(error, axis=1)) for error in errors.values())
    section.claim(
        'arm of every pair against the design, length of the difference',
        'within 1 mm',
        f'at most {worst:.2f} mm',
        worst < 1.0,
    )

    # Differences between the recordings, in their sds.
    apart = errors[NAMES[1]] - errors[NAMES[0]]
    expected = np.array(
        [1e3 * np.hypot(*(arms[name][pair].arm_sd for name in NAMES)) for pair in pairs]
    )
    in_sd = np.abs(apart / expected)
    section.claim(
        'arm of a pair from the two recordings, difference per axis',
        'within three of its sds (0.3 mm until 0.30 mm was seen)',
        f'at most {in_sd.max():.1f} sd, rms {_rms(in_sd):.2f} sd; at most {np.abs(apart).max():.2f}'
        f' mm, sds {expected.min():.2f} to {expected.max():.2f} mm',
        in_sd.max() < 3.0,
    )

    # Lengths over those of the design, and the clipped part of the moving time.
    ratios = []
    shares = []
    for name in NAMES:
        for pair in pairs:
            length = np.linalg.norm(arms[name][pair].arm)
            ratios.append(length / np.linalg.norm(design_mm(folder, name, pair)) * 1e3)
            shares.append(arms[name][pair].diagnostics['clipped_share'])
    section.claim(
        'baselines against the design',
        'a plain derivative makes them 2 to 6 % too long',
        f'{100 * (min(ratios) - 1):+.1f} to {100 * (max(ratios) - 1):+.1f} %',
    )
    rows = []
    for k, pair in enumerate(pairs):
        sd = [1e3 * arms[name][pair].arm_sd for name in NAMES]
        clipped = [f'{100 * arms[name][pair].diagnostics["clipped_share"]:.0f}' for name in NAMES]
        rows.append(
            (
                f'{pair[0]} → {pair[1]}',
                *(listed(errors[name][k], 2) for name in NAMES),
                listed(apart[k], 2),
                f'{max(s.max() for s in sd):.2f}',
                ' / '.join(clipped),
            )
        )
    section.table(
        (
            'pair',
            'array_2 − design, mm',
            'array_5 − design, mm',
            'array_5 − array_2, mm',
            'largest sd, mm',
            'clipped, % of moving time',
        ),
        rows,
    )
    section.say(
        text(
            'boards', expected=_rms(np.linalg.norm(expected, axis=1)), clipped=100 * np.mean(shares)
        )
    )
    _draw(section, plots, pairs, errors)
    return section


def _rms(values):
    return np.sqrt(np.mean(np.square(values)))


def _draw(section, plots, pairs, errors):
    figure, axes = new_figure(1, 3, (9, 3))
    for axis, panel in enumerate(axes):
        for name, marker in zip(NAMES, 'os'):
            panel.plot(errors[name][:, axis], marker, label=name)
        panel.axhline(0, color='grey', linewidth=0.8)
        panel.set(title=f'{"xyz"[axis]}', ylim=(-1, 1))
        panel.set_xticks(range(len(pairs)), [f'{a}→{b}' for a, b in pairs])
    axes[0].set_ylabel('arm minus design, mm')
    axes[0].legend()
    section.plot(
        plots,
        'boards.png',
        figure,
        'Arms between the IMUs of the board minus the design; the axes end where the limit is.',
    )
