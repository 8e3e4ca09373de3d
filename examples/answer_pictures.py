"""
Figures of the pages in docs/answers.

They are drawn from the files that the commands of the pages wrote into the current folder.
"""

from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure

from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.exporting import export_calibration
from imu_calibration.api.noise import identify_recording
from imu_calibration.api.recordings import Topics, source_of, temperatures
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.document import files
from imu_calibration.document.exports.export import all_targets
from imu_calibration.effects.base import AXES, SENSORS

RESULT = 'result/calibration.yaml'
UNIT = {'accelerometer': 'm/s²', 'gyroscope': 'rad/s'}
COLOURS = {'determined': '#7fbf7b', 'weak': '#fee08b', 'held': '#d9d9d9'}
RAW, LEFT, GOOD = '#bbbbbb', '#c0504d', '#4f81bd'


def figure(columns=1, height=3.2):
    drawn = Figure(figsize=(8.0, height), layout='constrained')
    return drawn, drawn.subplots(1, columns)


def readings(bag) -> ImuSamples:
    return ImuSamples.concatenate(
        [block.imu for block in source_of(bag, want_joints=False) if block.imu is not None]
    )


def save(drawn: Figure, path: Path):
    drawn.savefig(path, dpi=90, metadata={'Software': None})


def losses(names):
    calibration = files.read_calibration(RESULT)
    return {
        name: export_calibration(calibration, name, bag='session', axes='flu').loss
        for name in names
    }


def bars_of_loss(path, names, last=()):
    drawn, axes = figure(2)
    found = losses(names)
    for axis, sensor in zip(axes, SENSORS):
        values = [
            next(iter(found.values())).raw[sensor],
            *(loss.remaining[sensor] for loss in found.values()),
            *(0.0 for _ in last),
        ]
        axis.barh(
            ['raw readings', *found, *last],
            values,
            color=[RAW, *[LEFT] * len(found), *[GOOD] * len(last)],
        )
        axis.set(xlabel=f'{sensor}, residual error, {UNIT[sensor]} rms')
        axis.invert_yaxis()
    save(drawn, path)


def after_calibration(path):
    names = [
        name
        for name, target in all_targets().items()
        if target.write and not target.only_noise and not target.whole
    ]
    bars_of_loss(path, names, ('compensator_node',))


def missing_angles(path):
    drawn, axis = figure()
    force = readings('faces').force_s[::20]
    unit = force / np.linalg.norm(force, axis=1)[:, None]
    axis.plot(
        np.degrees(np.arctan2(unit[:, 1], unit[:, 0])),
        np.degrees(np.arcsin(unit[:, 2])),
        '.',
        color=GOOD,
        label='recorded attitudes',
    )
    axis.plot([135.0], [0.0], 'o', ms=12, mfc='none', mec=LEFT, label='requested: -x +y')
    axis.set(
        xlabel='direction that was up: from x to y, deg',
        ylabel='towards z, deg',
        xlim=(-185, 185),
        ylim=(-95, 95),
    )
    axis.legend(loc='upper left', fontsize=8)
    save(drawn, path)


def covariances(path):
    drawn, axes = figure(2)
    known, imu = yaml.safe_load(Path('covariances.yaml').read_text()), readings('session')
    for axis, values, name, sensor in zip(
        axes, (imu.force_s, imu.rate_s), ('linear_acceleration', 'angular_velocity'), SENSORS
    ):
        still = values[50:250] - values[50:250].mean(axis=0)
        sd = known[f'{name}_covariance'][0] ** 0.5
        grid = np.linspace(-4, 4, 200) * sd
        axis.hist(still.ravel(), bins=30, density=True, color=RAW, label='samples at rest')
        axis.plot(
            grid,
            np.exp(-((grid / sd) ** 2) / 2) / sd / np.sqrt(2 * np.pi),
            color=LEFT,
            label='covariance',
        )
        axis.set(xlabel=f'{sensor}, {UNIT[sensor]}', yticks=[])
        axis.legend(fontsize=8)
    save(drawn, path)


def warm_temperatures() -> TemperatureSamples:
    """Return the temperatures of the recording `warm`."""
    found = temperatures('warm', Topics())
    assert found is not None, 'the recording was simulated with temperatures'
    return found


def rest_against_temperature(imu):
    """Return (temperature, mean rate) of each second at rest."""
    warm, size = warm_temperatures(), 100
    count = len(imu) // size
    blocks = imu.rate_s[: count * size].reshape(count, size, 3)
    still = np.ptp(blocks, axis=1).max(axis=1) < 0.01
    origin = warm.stamp_ns[0]
    middle = (imu.stamp_ns[size // 2 :: size][:count] - origin) * 1e-9
    degrees = np.interp(middle, (warm.stamp_ns - origin) * 1e-9, warm.temperature_c)
    return degrees[still], np.degrees(blocks.mean(axis=1))[still]


def warming_up(path):
    drawn, axes = figure(2)
    corrected = compensate_recording('warm', 'warm_result/calibration.yaml').imu
    for axis, imu, title in zip(axes, (readings('warm'), corrected), ('raw', 'compensated')):
        degrees, rate = rest_against_temperature(imu)
        axis.plot(degrees, rate - (0 if title == 'compensated' else rate[0]), '.')
        axis.set(
            xlabel='temperature, °C', ylabel='rate at rest, deg/s', title=title, ylim=(-0.15, 0.25)
        )
    axes[0].legend(AXES, fontsize=8)
    save(drawn, path)


def when_to_store(path):
    drawn, axis = figure()
    known = files.read_calibration('warm_result/calibration.yaml')
    warm = warm_temperatures()
    axis.plot(
        (warm.stamp_ns - warm.stamp_ns[0]) * 1e-9,
        warm.temperature_c,
        color=LEFT,
        label='temperature during the recording',
    )
    axis.axhspan(
        *known.conditions['temperature_range_c'],
        color=GOOD,
        alpha=0.2,
        label='temperature range of the calibration',
    )
    axis.axhline(
        known.model.temperature_ref_c,
        ls='--',
        color=GOOD,
        label='reference temperature of the biases',
    )
    axis.set(xlabel='s', ylabel='°C', ylim=(20, 40))
    axis.legend(fontsize=8)
    save(drawn, path)


def without_a_camera(path):
    drawn, axis = figure()
    for shift, name in ((-0.2, 'on_table'), (0.2, 'by_hand')):
        found = files.read_calibration(f'{name}/calibration.yaml')
        chosen = [
            k
            for k, parameter in enumerate(found.param_names)
            if parameter.startswith('gyroscope.matrix')
        ]
        axis.bar(np.arange(9) + shift, found.sd[chosen], 0.4, label=name.replace('_', ' '))
    axis.axhline(1e-3, ls='--', color=LEFT, label='tolerance')
    axis.set(
        yscale='log',
        ylabel='sd of the gyroscope matrix',
        xticks=range(9),
        xticklabels=[a + b for a in AXES for b in AXES],
    )
    axis.legend(fontsize=8)
    save(drawn, path)


def only_about_z(path):
    drawn, axes = figure(2, 2.6)
    found = files.read_calibration('turning_result/calibration.yaml')
    status = dict(zip(found.param_names, found.status))
    for axis, sensor in zip(axes, SENSORS):
        cells = [
            [
                str(status[f'{sensor}.bias.{row}']),
                *(str(status[f'{sensor}.matrix.{row}{column}']) for column in AXES),
            ]
            for row in AXES
        ]
        axis.axis('off')
        axis.set_title(f'{sensor}: rows x, y, z', fontsize=10)
        shown = axis.table(
            cells,
            [[COLOURS[cell] for cell in row] for row in cells],
            colLabels=['bias', *(f'matrix {a}' for a in AXES)],
            loc='center',
            cellLoc='center',
        )
        shown.auto_set_font_size(False)
        shown.set_fontsize(8)
        shown.scale(1, 1.8)
    save(drawn, path)


def continuous_or_discrete(path):
    drawn, axis = figure()
    text = {
        name: yaml.safe_load(Path(file).read_text().replace('%YAML:1.0', ''))
        for name, file in (
            ('Kalibr', 'imu.yaml'),
            ('ORB-SLAM3', 'orb.yaml'),
            ('VINS', 'vins.yaml'),
            ('FAST-LIO', 'fast_lio.yaml'),
        )
    }
    values = (
        text['Kalibr']['gyroscope_noise_density'],
        text['ORB-SLAM3']['IMU.NoiseGyro'],
        text['VINS']['gyr_n'],
        text['FAST-LIO']['mapping']['gyr_cov'],
    )
    axis.bar(
        [
            'Kalibr, OpenVINS, basalt\nrad/s/√Hz',
            'ORB-SLAM3, LIO-SAM\nrad/s/√Hz',
            'VINS at 200 Hz\nrad/s',
            'FAST-LIO at 200 Hz\n(rad/s)²',
        ],
        values,
        color=GOOD,
    )
    axis.set(yscale='log', ylabel='the same gyroscope noise')
    save(drawn, path)


def noise_curve(path):
    identify_recording('rest').plot('gyroscope').save(path.with_suffix('.svg'), force=True)


def imu_calib(path):
    bars_of_loss(path, ['imu-calib'], ('compensator_node',))


PICTURES = {
    '1-after-calibration': after_calibration,
    '2-missing-angles': missing_angles,
    '3-covariances': covariances,
    '4-warming-up': warming_up,
    '5-when-to-store': when_to_store,
    '6-without-a-camera': without_a_camera,
    '7-only-about-z': only_about_z,
    '8-continuous-or-discrete': continuous_or_discrete,
    '9-noise': noise_curve,
    '9b-imu-calib': imu_calib,
}
"""Page -> function that draws its figure into a file."""
