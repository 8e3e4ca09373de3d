"""Model error of few rows: the scatter of parameters between blocks of them."""

import numpy as np
import scipy.linalg

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.model_error import ModelError, errors_of_waves, waves_of_blocks
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.references.rows.row_estimate import RowEstimate


def model_error_of_rows(
    rows: Rows, estimate: RowEstimate, model: SensorModel, *, block: np.ndarray
) -> ModelError:
    """
    Return the model error from shifts of the parameters between blocks of rows.

    The shifts count as far as they exceed noise and the scatter of the components. Their expected
    covariance is that of rows from which parameters and nuisances have been fitted.

    Parameters
    ----------
    rows : Rows
        At the estimate.
    estimate : RowEstimate
        The estimate from these rows.
    model : SensorModel
        Its parameters are those of the rows.
    block : array of int, shape (m,)
        Number of each row's block.

    """
    # Rows of unit variance; F is a basis of the nuisances, and the design has no part along it.
    white = flat(rows.with_scatter(estimate.scatter.variance).white())
    nuisances, design, residual = np.split(white, [rows.n_nuisances, white.shape[1] - 1], axis=1)
    basis = scipy.linalg.qr(nuisances, mode='economic')[0]
    design = design - basis @ (basis.T @ design)

    information = []
    gradient = []
    shared = []
    for number in range(block.max() + 1):
        in_block = block == number
        information.append(design[in_block].T @ design[in_block])
        gradient.append(design[in_block].T @ residual[in_block, 0])
        shared.append(basis[in_block].T @ design[in_block])
    waves = waves_of_blocks(
        np.array(information),
        np.array(gradient),
        np.zeros((0, len(estimate.free))),
        free=estimate.free,
        shared=np.array(shared),
    )
    return errors_of_waves(waves, model)[0]
