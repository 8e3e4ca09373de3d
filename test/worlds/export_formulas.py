"""
What other programs make of an exported file: their formulas and their file formats, written from their sources, one function for each.

Nothing of `imu_calibration.exports` is used here. Each function takes the text of a file and one sample and returns what stands in its
docstring. Sources are named by project and file.
"""

import json

import numpy as np
import yaml


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def kalibr(text, force, rate, alpha):
    """
    Return the readings (without bias) that Kalibr predicts for a true motion in its IMU frame.

    ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedSizeEffectImu.addAccelerometerErrorTerms and
    IccScaledMisalignedImu.addGyroscopeErrorTerms, with C_i_b = I, r_b = 0.
    """
    data = yaml.safe_load(text)
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

    rpng/open_vins: the file is read by VioManagerOptions.h (print_and_load_state), which inverts Tw and Ta and keeps the lower (model
    kalibr) or upper (rpng) triangle of the inverse column by column; State.h (Dm, Tg) builds the matrices; Propagator.cpp applies them.
    """
    chain = yaml.safe_load(text.split('\n', 1)[1])['imu0']
    get = {name: np.array(chain.get(name, default)) for name, default in
           (('Tw', np.eye(3)), ('Ta', np.eye(3)), ('R_IMUtoACC', np.eye(3)), ('R_IMUtoGYRO', np.eye(3)), ('Tg', np.zeros((3, 3))))}
    dw, da = np.linalg.inv(get['Tw']), np.linalg.inv(get['Ta'])
    half = np.tril if chain['model'] == 'kalibr' else np.triu
    a = get['R_IMUtoACC'].T @ half(da) @ am
    return a, get['R_IMUtoGYRO'].T @ half(dw) @ (wm - get['Tg'] @ a)


def basalt(text, accel, gyro):
    """Return calibrated readings; VladyslavUsenko/basalt-headers, calib_bias.hpp, CalibAccelBias and CalibGyroBias::getCalibrated."""
    value = json.loads(text)['value0']
    full = value['calib_accel_bias']
    scale = np.zeros((3, 3))
    scale[:, 0] = full[3:6]
    scale[1, 1], scale[2, 1], scale[2, 2] = full[6:9]
    gyro_full = value['calib_gyro_bias']
    gyro_scale = np.stack([gyro_full[3:6], gyro_full[6:9], gyro_full[9:12]], axis=1)
    return accel + scale @ accel - full[:3], gyro + gyro_scale @ gyro - gyro_full[:3]
