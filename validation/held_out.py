"""
Prediction errors of this project, a plain gravity-norm fit and imucal on the same held-out poses.
"""

import numpy as np
from scipy.stats import t

from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions
from validation.ferraris import GRAVITY, RATE_HZ, calibrate_sections, known_turns
from validation.ferraris import NAME as FERRARIS
from validation.recordings import BY_HAND, gravity_of, label, load, reference
from validation.second_opinions import (
    FACES,
    Forward,
    accelerometer_of,
    ferraris,
    fit_norm,
    installed,
)
from validation.section import Section, text

FEW, SPLITS, DRAWS, SEED = 12, 20, 10_000, 20
"""Poses of the small training sets, how many of them, bootstrap draws, seed of both."""
LEFT_OUT = None
"""Poses of a recording that are left out, one at a time; None for all."""


def mean_forces(imu, ranges):
    """Return the mean readings over the poses, m/s^2, shape (k, 3)."""
    return np.array([imu.force_s[r].mean(axis=0) for r in ranges])


def without(imu, ranges, left_out):
    """
    Return (imu, ranges) as if the poses with the numbers `left_out` had never been recorded.

    Their samples are cut out, so that neither poses nor longer turns contain them.
    """
    keep = np.ones(len(imu), bool)
    for k in left_out:
        keep[ranges[k]] = False
    place = np.concatenate([[0], np.cumsum(keep)])
    return imu.select(keep), [
        slice(int(place[r.start]), int(place[r.stop]))
        for k, r in enumerate(ranges)
        if k not in set(left_out)
    ]


def ours(imu, ranges, left_out, gravity):
    """Return our accelerometer from the other poses and the turns between them."""
    rest, kept = without(imu, ranges, left_out)
    return Forward(*calibrate_by_hand(rest, HandOptions(gravity), kept).accelerometer)


def errors_of_splits(imu, ranges, gravity, splits):
    """
    Return {'ours', 'norm fit', 'uncalibrated': list of arrays}.

    ``|force| - g`` of the held-out poses of each split.
    """
    force, result = mean_forces(imu, ranges), {'ours': [], 'norm fit': [], 'uncalibrated': []}
    for left_out in splits:
        rest = np.setdiff1d(np.arange(len(ranges)), left_out)
        sensors = {
            'ours': ours(imu, ranges, left_out, gravity),
            'norm fit': fit_norm(force[rest], gravity),
            'uncalibrated': Forward(np.zeros(3), np.eye(3)),
        }
        for name, sensor in sensors.items():
            result[name].append(sensor.norm_errors(force[left_out], gravity))
    return result


def rms(errors):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def bootstrap_difference(first, second, rng):
    """
    Return the 95 % interval of rms(second) - rms(first) over the same poses, drawn again together.
    """
    picks = rng.integers(len(first), size=(DRAWS, len(first)))
    drawn = [np.sqrt(np.mean(np.square(errors)[picks], axis=1)) for errors in (first, second)]
    return np.quantile(drawn[1] - drawn[0], [0.025, 0.975])


def resampled_ratio(first, second, share):
    """
    Return (geometric mean of rms(second) / rms(first), its 95 % interval).

    The mean is over repeated splits of the same poses.

    Splits share poses, so that the variance of the mean is ``(1/J + n_test/n_train) var`` (Nadeau
    and Bengio 2003).
    """
    ratios = np.log([rms(b) / rms(a) for a, b in zip(first, second)])
    half = t.ppf(0.975, len(ratios) - 1) * np.sqrt((1 / len(ratios) + share) * ratios.var(ddof=1))
    return np.exp(ratios.mean()), np.exp(ratios.mean() + np.array([-half, half]))


def leave_one_out(imu, ranges, gravity, rng):
    """
    Return ({method: rms}, interval of norm fit minus ours, errors) with every pose left out once.
    """
    splits = [np.array([k]) for k in range(len(ranges))][:LEFT_OUT]
    found = errors_of_splits(imu, ranges, gravity, splits)
    errors = {name: np.concatenate(parts) for name, parts in found.items()}
    return (
        {name: rms(values) for name, values in errors.items()},
        bootstrap_difference(errors['ours'], errors['norm fit'], rng),
        errors,
    )


def few_poses(imu, ranges, gravity, rng):
    """
    Return ({method: median rms}, (ratio of norm fit to ours, interval)).

    The fit uses FEW poses, and the remaining ones are held out.
    """
    splits = [np.sort(rng.permutation(len(ranges))[FEW:]) for _ in range(SPLITS)]
    found = errors_of_splits(imu, ranges, gravity, splits)
    ratio = resampled_ratio(found['ours'], found['norm fit'], (len(ranges) - FEW) / FEW)
    return {
        name: float(np.median([rms(e) for e in errors])) for name, errors in found.items()
    }, ratio


def faces_and_the_rest(folder):
    """
    Return {method: errors on the rests outside the sections} for ferraris.

    It is the ferraris recording, with six faces and three turns for all.

    Nine parameters cannot be fitted to the norm in six poses: the plain fit has biases and scale
    factors only.
    """
    imu, known = load(folder, FERRARIS), reference(folder, FERRARIS)
    sections, angle = known['sections'], np.radians(known['turn_deg'])
    used = np.zeros(len(imu), bool)
    for part in sections.values():
        used[slice(*part)] = True
    rests = [r for r in find_still(imu) if not used[r].any()]
    force = mean_forces(imu, rests)
    found, _ = calibrate_sections(imu, sections, angle)
    methods = {
        'ours': Forward(*found.accelerometer),
        'norm fit': fit_norm(
            mean_forces(imu, [slice(*sections[name]) for name in FACES]), GRAVITY, cross_axis=False
        ),
        'uncalibrated': Forward(np.zeros(3), np.eye(3)),
    }
    if installed('imucal'):
        sign = np.sign(known_turns(imu, sections, angle)[0].angle)
        methods['imucal'] = accelerometer_of(
            ferraris(imu, sections, RATE_HZ, GRAVITY, sign * angle)
        )
    return {name: method.norm_errors(force, GRAVITY) for name, method in methods.items()}


def off_faces(imu, ranges):
    """Return the angles between the six faces and the poses nearest to them, deg, shape (6,)."""
    force = mean_forces(imu, ranges)
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    return np.degrees(
        np.arccos(np.clip(np.concatenate([directions.max(axis=0), -directions.min(axis=0)]), -1, 1))
    )


def _verdict(interval, better='ours', other='norm fit'):
    if interval[0] > 0:
        return better
    return other if interval[1] < 0 else 'no difference seen'


def run(folder, plots):
    """Return the section."""
    section = Section('Who predicts better: poses that took no part')
    rows = []  # every pose left out once
    few = []  # few poses for the fit
    faces = []
    errors_of = {}  # recording -> errors of the poses that were left out
    for name, topic in BY_HAND:
        rng = np.random.default_rng(SEED)
        gravity = gravity_of(folder, name)
        imu = load(folder, name, topic)
        recording = label(name, topic)
        ranges = find_still(imu)
        values, interval, errors_of[recording] = leave_one_out(imu, ranges, gravity, rng)
        rows.append(_row(recording, len(ranges), values, interval))
        values, (ratio, interval) = few_poses(imu, ranges, gravity, rng)
        ratio_text = f'{ratio:.2f} [{interval[0]:.2f}, {interval[1]:.2f}]'
        # The logarithm of the ratio is 0 where both are equally good.
        few.append((*_start(recording, FEW, values), ratio_text, _verdict(np.log(interval))))
        faces.append(f'{off_faces(imu, ranges).max():.0f} deg ({recording})')
    head = (
        'recording',
        'poses',
        'uncalibrated',
        'norm fit',
        'ours',
        'norm fit − ours [95 %]',
        'better',
    )
    section.say(text('held_out_errors'))
    section.table(head, rows)
    section.say(text('held_out_few', splits=SPLITS, few=FEW))
    section.table((*head[:5], 'norm fit / ours [95 %]', 'better'), few)
    _six_faces(section, folder)
    section.say(text('held_out_imucal', faces=', '.join(faces)))
    _count(section, rows, few)
    _draw(section, plots, errors_of)
    return section


def _start(name, count, values):
    return (
        name,
        str(count),
        f'{1e3 * values["uncalibrated"]:.0f}',
        *(f'{1e3 * values[key]:.2f}' for key in ('norm fit', 'ours')),
    )


def _row(name, count, values, interval):
    return (
        *_start(name, count, values),
        f'[{1e3 * interval[0]:+.2f}, {1e3 * interval[1]:+.2f}]',
        _verdict(interval),
    )


def _six_faces(section, folder):
    errors = faces_and_the_rest(folder)
    rng = np.random.default_rng(SEED)
    rows = []
    for name in ('uncalibrated', 'norm fit', 'imucal', 'ours'):
        if name in errors:
            minus_ours = ''
            if name != 'ours':
                low, high = 1e3 * bootstrap_difference(errors['ours'], errors[name], rng)
                minus_ours = f'[{low:+.2f}, {high:+.2f}]'
            rows.append((name, f'{1e3 * rms(errors[name]):.2f}', minus_ours))
    section.say(text('held_out_faces', rests=len(errors['ours'])))
    section.table(('method', 'rms of the rests, mm/s²', 'minus ours [95 %]'), rows)


def _count(section, rows, few):
    for what, table in (('every pose left out once', rows), (f'{FEW} poses for the fit', few)):
        better = [row[-1] for row in table]
        section.claim(
            f'poses that took no part, norm fit beside ours, {what}',
            'whoever predicts better',
            f'ours better in {better.count("ours")}, norm fit in {better.count("norm fit")}, no'
            f' difference seen in {better.count("no difference seen")} of {len(better)}',
            headline=table is rows,
        )


def _draw(section, plots, everything):
    from validation.figures import new_figure

    figure, axes = new_figure(1, 1, (8, 4))
    for k, (name, errors) in enumerate(everything.items()):
        for shift, method, colour in (
            (-0.13, 'norm fit', 'tab:orange'),
            (0.13, 'ours', 'tab:blue'),
        ):
            values = 1e3 * np.abs(errors[method])
            axes.plot(
                np.full(len(values), k + shift),
                values,
                '.',
                color=colour,
                alpha=0.5,
                label=method if k == 0 else None,
            )
            axes.plot(
                [k + shift - 0.1, k + shift + 0.1],
                [1e3 * rms(errors[method])] * 2,
                color=colour,
                linewidth=2,
            )
    axes.set(yscale='log', ylabel='error of a pose left out, mm/s²', ylim=(0.01, None))
    axes.set_xticks(range(len(everything)), everything, rotation=30, ha='right')
    axes.legend()
    section.plot(
        plots,
        'held_out.png',
        figure,
        'Every pose left out once: errors of the poses (dots) and their rms (bars).',
    )
