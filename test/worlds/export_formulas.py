"""
What other programs make of an exported file.

Their formulas and their file formats, written from their sources, one function for each.

Nothing of `imu_calibration.document.exports` is used here. Each function takes the text of a file
and one sample and returns what stands in its docstring. Sources are named by project and file.
"""

import json

import numpy as np
import yaml


def safe_load(text):
    return yaml.load(text, getattr(yaml, 'CSafeLoader', yaml.SafeLoader))


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def kalibr(text, force, rate, alpha):
    """
    Return the readings (without bias) that Kalibr predicts for a true motion in its IMU frame.

    ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedSizeEffectImu.addAccelerometerErrorTerms and
    IccScaledMisalignedImu.addGyroscopeErrorTerms, with C_i_b = I, r_b = 0.
    """
    data = safe_load(text)
    accel, gyro = data['accelerometers'], data['gyroscopes']
    m, mg, c, ma = (np.array(x) for x in (accel['M'], gyro['M'], gyro['C_gyro_i'], gyro['A']))
    inner = force.copy()
    for axis, name in enumerate(('rx_i', 'ry_i', 'rz_i')):
        r = np.array(accel.get(name, [0.0, 0.0, 0.0]))
        pick = np.diag(np.eye(3)[axis])
        inner = inner + pick @ (np.cross(alpha, r) + np.cross(rate, np.cross(rate, r)))
    return m @ inner, mg @ (c @ rate) + ma @ (c @ force)


def openvins(text, am, wm):
    """
    Return corrected (force, rate) in the IMU frame, without biases.

    rpng/open_vins: the file is read by VioManagerOptions.h (print_and_load_state), which inverts Tw
    and Ta and keeps the lower (model kalibr) or upper (rpng) triangle of the inverse column by
    column; State.h (Dm, Tg) builds the matrices; Propagator.cpp applies them.
    """
    chain = safe_load(text.split('\n', 1)[1])['imu0']
    get = {
        name: np.array(chain.get(name, default))
        for name, default in (
            ('Tw', np.eye(3)),
            ('Ta', np.eye(3)),
            ('R_IMUtoACC', np.eye(3)),
            ('R_IMUtoGYRO', np.eye(3)),
            ('Tg', np.zeros((3, 3))),
        )
    }
    dw, da = np.linalg.inv(get['Tw']), np.linalg.inv(get['Ta'])
    half = np.tril if chain['model'] == 'kalibr' else np.triu
    a = get['R_IMUtoACC'].T @ half(da) @ am
    return a, get['R_IMUtoGYRO'].T @ half(dw) @ (wm - get['Tg'] @ a)


def basalt(text, accel, gyro):
    """
    Return calibrated readings.

    VladyslavUsenko/basalt-headers, calib_bias.hpp, CalibAccelBias and CalibGyroBias::getCalibrated.
    """
    value = json.loads(text)['value0']
    full = value['calib_accel_bias']
    scale = np.zeros((3, 3))
    scale[:, 0] = full[3:6]
    scale[1, 1], scale[2, 1], scale[2, 2] = full[6:9]
    gyro_full = value['calib_gyro_bias']
    gyro_scale = np.stack([gyro_full[3:6], gyro_full[6:9], gyro_full[9:12]], axis=1)
    return accel + scale @ accel - full[:3], gyro + gyro_scale @ gyro - gyro_full[:3]


def parameters(text):
    """
    Return {name: value} of a list of parameters: the last two words that are a NAME and its value.
    """
    found = {}
    for line in text.splitlines():
        words = line.replace(',', ' ').split()
        if words and not line.startswith('#'):
            name = next(word for word in words if word[0].isalpha())
            found[name] = float(words[words.index(name) + 1])
    return found


def px4(text, accel, gyro, temperature_c):
    """
    Return corrected (accel, gyro), all in the sensor's forward-right-down axes.

    PX4/PX4-Autopilot, Accelerometer.hpp and Gyroscope.hpp (Correct), temperature_compensation.cpp
    (calc_thermal_offsets_3D).
    """
    p = parameters(text)

    def thermal(letter):
        if p.get(f'TC_{letter}_ENABLE', 0) != 1:
            return np.zeros(3)
        n = f'TC_{letter}0_'
        delta = min(max(temperature_c, p[n + 'TMIN']), p[n + 'TMAX']) - p[n + 'TREF']
        return np.array(
            [
                p[f'{n}X0_{i}']
                + p[f'{n}X1_{i}'] * delta
                + p[f'{n}X2_{i}'] * delta**2
                + p[f'{n}X3_{i}'] * delta**3
                for i in range(3)
            ]
        )

    offset = np.array([p[f'CAL_ACC0_{a}OFF'] for a in 'XYZ'])
    scale = np.array([p[f'CAL_ACC0_{a}SCALE'] for a in 'XYZ'])
    gyro_offset = np.array([p[f'CAL_GYRO0_{a}OFF'] for a in 'XYZ'])
    return (accel - thermal('A') - offset) * scale, gyro - thermal('G') - gyro_offset


def ardupilot(text, accel, gyro, temperature_c):
    """
    Return corrected (accel, gyro), all in the autopilot's forward-right-down axes.

    These are the axes before the board's orientation.

    ArduPilot/ardupilot, AP_InertialSensor_Backend.cpp (_rotate_and_correct_accel,
    _rotate_and_correct_gyro), AP_InertialSensor_tempcal.cpp (polynomial_eval, correct_sensor).
    """
    p = parameters(text)

    def tcal(kind, value, cal_temp):
        if p.get('INS_TCAL1_ENABLE', 0) != 1:
            return value
        c = [np.array([p[f'INS_TCAL1_{kind}{order}_{a}'] for a in 'XYZ']) for order in (1, 2, 3)]
        low, high = p['INS_TCAL1_TMIN'], p['INS_TCAL1_TMAX']

        def evaluate(tdiff):
            return (c[0] + (c[1] + c[2] * tdiff) * tdiff) * tdiff * 1.0e-6

        now, then = (min(max(t, low), high) for t in (temperature_c, cal_temp))
        return value - evaluate(now - 35.0) + evaluate(then - 35.0)

    def vector(name):
        return np.array([p[f'{name}_{a}'] for a in 'XYZ'])

    accel = tcal('ACC', accel, p.get('INS_ACC1_CALTEMP', -300.0)) - vector('INS_ACCOFFS')
    return accel * vector('INS_ACCSCAL'), tcal(
        'GYR', gyro, p.get('INS_GYR1_CALTEMP', -300.0)
    ) - vector('INS_GYROFFS')


def autoware(text, accel, gyro):
    """
    Return (accel, gyro) before the turn to base_link.

    With the scale that the comment of the file tells to publish.

    autowarefoundation/autoware_universe, imu_corrector_core.cpp (callback_imu).
    """
    p = safe_load(text)['/**']['ros__parameters']
    told = next(line for line in text.splitlines() if 'gyro_scale_input geometry_msgs' in line)
    scale = safe_load(told[told.index('"') + 1 : told.rindex('"')])['vector']
    if (
        p['on_off_correction']['correct_for_static_bias']
        and not p['on_off_correction']['correct_for_dynamic_bias']
    ):
        gyro = gyro - [p[f'angular_velocity_offset_{a}'] for a in 'xyz']
    return accel, gyro / [scale[a] for a in 'xyz']


def imu_calib(text, accel, gyro):
    """
    Return corrected accel, and gyro as it is.

    Dpkoch/imu_calib, accel_calib.cpp (loadCalib, applyCalib).
    """
    node = safe_load(text)
    matrix = np.array([[node['SM'][3 * i + j] for j in range(3)] for i in range(3)])
    return matrix @ accel - node['bias'], gyro


def imu_tk(text, raw):
    """
    Return calibrated readings of one sensor.

    Imu_tk, calibration.h (CalibratedTriad_::load, unbiasNormalize).
    """
    values = [float(word) for word in text.split()]
    mis, scale, bias = (
        np.reshape(values[:9], (3, 3)),
        np.reshape(values[9:18], (3, 3)),
        np.array(values[18:21]),
    )
    return mis @ scale @ (raw - bias)


def spread_in_a_second(name, text, dt):
    """
    Return the variances that an estimator expects after one second.

    They are {(sensor, 'white' or 'walk'): value}.

    'white': of the integral of a sensor's readings, were they nothing but noise; 'walk': of its
    bias. For each: the variance of one step in the program's own code, with the names in its file,
    times the number of steps.
    """
    steps = 1.0 / dt
    head = text.split('\n', 1)[1] if text.startswith('%YAML') else text
    c = safe_load(head) if name != 'basalt' else json.loads(text)['value0']
    pairs = {'accelerometer': ('acc', 'Acc'), 'gyroscope': ('gyr', 'Gyr')}
    if name == 'kalibr':
        # IccSensors.py: noise density * sqrt(rate) is the sd of a sample; the walk enters a
        # continuous spline
        found = {
            s: (
                (c[f'{s}_noise_density'] * c['update_rate'] ** 0.5 * dt) ** 2 * steps,
                c[f'{s}_random_walk'] ** 2,
            )
            for s in pairs
        }
    elif name == 'openvins':  # Propagator.cpp: Qc = sigma^2 / dt, propagated with dt
        found = {
            s: (
                c['imu0'][f'{s}_noise_density'] ** 2 / dt * dt**2 * steps,
                c['imu0'][f'{s}_random_walk'] ** 2 / dt * dt**2 * steps,
            )
            for s in pairs
        }
    elif name == 'vins':
        # Integration_base.h, midPointIntegration: V has 0.5 dt for each of two samples, dt for the
        # bias
        found = {
            s: (2 * (0.5 * dt * c[f'{a}_n']) ** 2 * steps, (dt * c[f'{a}_w']) ** 2 * steps)
            for s, (a, _) in pairs.items()
        }
    elif name == 'lio-sam':
        # imuPreintegration.cpp: covariance = I imuGyrNoise^2 (gtsam: continuous), between factor
        # sqrt(dt) * imuGyrBiasN
        found = {
            s: (
                c['lio_sam'][f'imu{b}Noise'] ** 2 * dt * steps,
                c['lio_sam'][f'imu{b}BiasN'] ** 2 * dt * steps,
            )
            for s, (_, b) in pairs.items()
        }
    elif name == 'fast-lio':  # esekfom.hpp, predict: P += (dt f_w) Q (dt f_w)'
        found = {
            s: (
                dt**2 * c['mapping'][f'{a}_cov'] * steps,
                dt**2 * c['mapping'][f'b_{a}_cov'] * steps,
            )
            for s, (a, _) in pairs.items()
        }
    elif name == 'orb-slam3':
        # Tracking.cc: Calib(Ng sqrt(f), Na sqrt(f), Ngw / sqrt(f), Naw / sqrt(f)); ImuTypes.cc adds
        # the walk per step
        f = c['IMU.Frequency']
        long = {'accelerometer': 'Acc', 'gyroscope': 'Gyro'}
        found = {
            s: (
                (c[f'IMU.Noise{n}'] * f**0.5 * dt) ** 2 * steps,
                (c[f'IMU.{n}Walk'] / f**0.5) ** 2 * steps,
            )
            for s, n in long.items()
        }
    elif name == 'basalt':
        # calibration.hpp: std * sqrt(rate) is the sd of a sample; sqrt_vio_estimator: bias weight 1
        # / (std sqrt(dt))
        short = {'accelerometer': 'accel', 'gyroscope': 'gyro'}
        found = {
            s: (
                (c[f'{n}_noise_std'][0] * c['imu_update_rate'] ** 0.5 * dt) ** 2 * steps,
                c[f'{n}_bias_std'][0] ** 2 * dt * steps,
            )
            for s, n in short.items()
        }
    return {
        (sensor, kind): value
        for sensor, pair in found.items()
        for kind, value in zip(('white', 'walk'), pair)
    }
