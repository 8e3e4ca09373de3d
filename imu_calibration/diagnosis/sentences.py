"""Findings as sentences that an engineer would write."""

import numpy as np

DEG = np.pi / 180
READABLE = {'m/s^2': (9.80665e-3, 'mg'), 'rad/s': (DEG, 'deg/s'), 'rad': (DEG / 60, 'arcmin'), 's': (1e-3, 'ms'), 'm': (1e-3, 'mm'),
            '1': (1e-6, 'ppm'), 'm/s^2/K': (9.80665e-3, 'mg/K'), 'rad/s/K': (DEG, 'deg/s/K'), '1/K': (1e-6, 'ppm/K'),
            '(m/s^2)^-1': (1e-3 / 9.80665, 'mg/g^2'),
            '(m/s^2)^-2': (1e-3 / 9.80665**2, 'mg/g^3'), '(rad/s)^-1': (1e-6 / DEG, 'ppm per deg/s'),
            '(rad/s)/(m/s^2)': (DEG / 9.80665, 'deg/s/g')}
"""SI unit -> (size of the readable unit in SI, its name)."""


def sentence(effect, parameters, gain, n_clipped=None):
    """
    Return what was found in one or two sentences, with its size in units that people use.

    Parameters
    ----------
    effect : Effect
    parameters : dict
        Name -> (value, sd, unit).
    gain : Gain or None
    n_clipped : int, optional
        Samples at a limit.

    """
    values = [(name.split('.')[-1], *entry) for name, entry in parameters.items()]
    label, value, sd, unit = max((v for v in values if v[0] != 'time_constant' or len(values) == 1), key=lambda v: abs(v[1]))
    size = _size(value, sd, unit)
    if n_clipped is not None:
        return (f'{effect.explanation} The limit is {readable(value, unit)}; {n_clipped} samples sit on it and were left out, with those '
                'close to it.')
    which = '' if len(values) == 1 else f' (largest: {label})'
    text = f'{effect.explanation} Its size is {size}{which}.'
    if gain is not None and gain.reduction > 0:
        text += f' With it the {gain.sensor} residual of held-out {gain.measure} falls by {100 * gain.reduction:.0f} %.'
    return text


def _size(value, sd, unit):
    step, name = READABLE.get(unit, (1.0, unit))
    digits = max(0, 1 - int(np.floor(np.log10(max(sd / step, 1e-12)))))
    return f'{value / step:.{min(digits, 6)}f} +- {sd / step:.{min(digits, 6)}f} {name}'


def readable(value, unit):
    """Return a value with three digits in a unit that people use."""
    step, name = READABLE.get(unit, (1.0, unit))
    return f'{value / step:.4g} {name}'
