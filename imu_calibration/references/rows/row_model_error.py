"""Model error of few rows: the scatter of parameters between blocks of them."""

import numpy as np
import scipy.linalg

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.model_error import ModelError, errors_of_waves, waves_of_blocks
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.references.rows.row_estimate import RowEstimate


def model_error_of_rows(
    rows: Rows, found: RowEstimate, model: SensorModel, *, block: np.ndarray
) -> ModelError:
    """
    Return the model error from the scatter of parameters between blocks of rows.

    It is the scatter beyond noise and known scatter.

    Nuisances are estimated too, so that the expected covariance of the shifts is the one of rows
    from which these, and the parameters, have been fitted.

    Parameters
    ----------
    rows : Rows
        At the estimate.
    found : RowEstimate
    model : SensorModel
        Its parameters are those of the rows.
    block : array of int, shape (m,)
        Number of each row's block.

    """
    # Rows of unit variance, the design without its part along the nuisances (F F' A).
    white = flat(rows.with_scatter(found.scatter.variance).white())
    nuisances, main, rest = np.split(white, [rows.n_nuisances, white.shape[1] - 1], axis=1)
    fitted = scipy.linalg.qr(nuisances, mode='economic')[0]
    main = main - fitted @ (fitted.T @ main)

    information = []
    gradient = []
    shared = []
    for number in range(block.max() + 1):
        own = block == number
        information.append(main[own].T @ main[own])
        gradient.append(main[own].T @ rest[own, 0])
        shared.append(fitted[own].T @ main[own])
    waves = waves_of_blocks(
        np.array(information),
        np.array(gradient),
        np.zeros((0, len(found.free))),
        free=found.free,
        shared=np.array(shared),
    )
    return errors_of_waves(waves, model)[0]
