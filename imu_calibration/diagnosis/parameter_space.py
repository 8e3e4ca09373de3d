"""From columns to parameters: each window's contribution to a linear problem in the parameters of everything that is asked."""

from dataclasses import dataclass, field

import numpy as np

from imu_calibration.diagnosis.questions import Question, special
from imu_calibration.diagnosis.reduced_recording import own_rows
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian


@dataclass(frozen=True, eq=False)
class Space:
    """Parameters of the diagnosis: those of the extended model, then the banks of warm-ups (constant by axis, per sensor)."""

    lifted: object
    """The Lifted recording."""
    names: tuple
    """Parameter names."""
    prior_sd: np.ndarray
    """Prior standard deviations, shape (q,)."""
    prior_mean: np.ndarray
    """Prior minus the values of the linearisation, shape (q,)."""
    index: dict
    """Sensor -> three index arrays: the parameters that act on each axis."""
    mean: dict
    """Sensor -> three arrays (k, q_a + 1): mean rows ``[design | residual]``."""
    within: dict
    """Sensor -> three arrays (k, q_a + 1, q_a + 1): products of the centred rows."""
    slow: dict
    """Sensor -> the same of their slow part."""
    slow_only: dict = field(default_factory=dict)
    """Sensor -> whether only the slow part of the centred rows is compared, shape (3,)."""

    @property
    def size(self):
        """Number of parameters."""
        return len(self.names)


def parameter_space(lifted, baseline):
    """
    Return the Space of a lifted recording: the Jacobian of the coefficients joins columns to parameters.

    Parameters of the baseline count from the values of the linearisation; those of all other effects from nothing, so that an
    effect that is left out is absent even where the columns were taken with it.

    Parameters
    ----------
    baseline : SensorModel
        The model that is diagnosed.

    """
    model, n_bank = lifted.model, len(lifted.constants)
    names = list(model.param_names)
    prior, sd = model.prior()
    for effect in model.effects:
        if effect.name.endswith('_bias_drift'):
            prior[model.slices[effect.sensor, effect.name]][-1] = lifted.values[model.slices[effect.sensor, effect.name]][-1]
    in_baseline = counted_from_values(model, baseline)
    shift = np.where(in_baseline, prior - lifted.values, prior)
    removed = np.where(in_baseline, 0.0, lifted.values)
    for short in ('accel', 'gyro'):
        names += [f'{short}_warm_up.{k}.{axis}' for k in range(n_bank) for axis in 'xyz']
    q_model, q = len(model.param_names), len(names)
    bank_sd = np.concatenate([np.full(3 * n_bank, 0.5), np.full(3 * n_bank, 0.05)])
    index, mean, within, slow = {}, {}, {}, {}
    for number, sensor in enumerate(SENSORS):
        jacobian = own_jacobian(model, sensor, lifted.values)
        p = len(jacobian)
        index[sensor], mean[sensor], within[sensor], slow[sensor] = [], [], [], []
        for axis in range(3):
            full = np.zeros((p + n_bank, q))
            full[:p, :q_model] = jacobian[:, axis]
            full[p + np.arange(n_bank), q_model + 3 * n_bank * number + 3 * np.arange(n_bank) + axis] = 1.0
            used = np.flatnonzero(np.any(full != 0, axis=0))
            take = np.r_[np.arange(p + n_bank), p + n_bank + axis]
            join = np.zeros((len(take), len(used) + 1))
            join[:-1, :-1], join[-1, -1] = full[:, used], 1.0
            join[:-1, -1] = full[:, :q_model] @ removed
            index[sensor].append(used)
            mean[sensor].append(lifted.mean[sensor][:, take] @ join)
            for found, products in ((within, lifted.gram), (slow, lifted.slow)):
                found[sensor].append(join.T @ (products[sensor][:, take[:, None], take[None, :]] @ join))
    return Space(lifted, tuple(names), np.concatenate([sd, bank_sd]), np.concatenate([shift, np.zeros(6 * n_bank)]), index, mean, within, slow)


def counted_from_values(model, baseline):
    """Return a mask of the parameters that count from the linearisation: the baseline's, and time constants of warm-ups."""
    masks = [np.full(e.size, (e.sensor, e.name) in baseline.slices) for e in model.effects]
    for effect, mask in zip(model.effects, masks):
        if effect.name.endswith('_bias_drift'):
            mask[-1] = True
    return np.concatenate(masks)


def own_jacobian(model, sensor, values):
    """Return d(coefficients)/d(values) of the columns of the diagnosis, shape (n_columns, 3, n_params)."""
    return coefficient_jacobian(model, sensor, values)[own_rows(model, sensor)]


def questions(space, effects):
    """Return a Question for each effect; a warm-up gives one per time constant of the bank."""
    model, constants = space.lifted.model, space.lifted.constants
    n_bank, q_model = len(constants), len(model.param_names)
    asked = []
    for effect in effects:
        if (effect.sensor, effect.name) in model.slices:
            part = model.slices[effect.sensor, effect.name]
            asked.append(Question(effect, tuple(range(part.start, part.stop)), effect.size, effect.name))
        elif special(effect) and effect.name.endswith('_bias_drift'):
            start = q_model + 3 * n_bank * SENSORS.index(effect.sensor)
            for k in range(n_bank):
                asked.append(Question(effect, tuple(range(start + 3 * k, start + 3 * k + 3)), 4, f'{effect.name}@{k}'))
    return asked


def smooth_parameters(asked):
    """Return sensor -> list of the parameters of effects that are smooth in time: thermal bias and warm-ups."""
    smooth = [q for q in asked if q.name.endswith(('_thermal_bias', '_bias_drift'))]
    return {sensor: [q.parameters for q in smooth if q.sensor == sensor] for sensor in SENSORS}
