"""Rows of one axis, each an equation of its own, from their columns."""

import numpy as np

from imu_calibration.estimation.rows import Rows


def scalar_rows(
    nuisances: np.ndarray,
    columns: np.ndarray,
    residual: np.ndarray,
    *,
    variance: np.ndarray,
    component: np.ndarray,
    group: np.ndarray,
    end_group: np.ndarray | None = None,
) -> Rows:
    """
    Return rows of one axis; the columns have the shapes (m, d) and (m, n), all others (m,).

    Without `end_group` a row begins and ends in its group.
    """
    return Rows(
        equations=np.column_stack([nuisances, columns, residual])[:, None],
        variance=variance[:, None],
        component=component,
        group=group,
        end_group=group if end_group is None else end_group,
        n_nuisances=nuisances.shape[1],
    )
