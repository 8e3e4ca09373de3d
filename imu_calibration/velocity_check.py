"""Can the velocities of the joint states be believed? Drivers leave them empty, fill them with zeros or filter them."""

import numpy as np


def check_velocity(velocity, rate, acceleration, dof, settings):
    """
    Compare a joint's velocities with those of its positions, ``velocity = offset + scale rate - lag acceleration + noise``.

    Parameters
    ----------
    velocity : array, shape (n,)
        Velocities of the joint states, rad/s; NaN where there is none.
    rate, acceleration : array, shape (n,)
        Derivatives of the smooth curve through the positions at the same stamps.
    dof : float
        Effective number of parameters of that curve: so many of its values are independent.
    settings : JointSettings
        Largest disagreement, which must be excluded by two standard errors.

    Returns
    -------
    trusted : bool
        Whether scale, lag and offset agree; false when the motion is too weak to tell.
    noise_sd : float
        Scatter of the velocities, rad/s, that of the curve included.

    """
    good = np.isfinite(velocity)
    if good.mean() < 0.9 or not np.any(velocity[good]):
        return False, np.inf
    columns = np.stack([np.ones(good.sum()), rate[good], -acceleration[good]], axis=1)
    size = np.sqrt(np.mean(columns ** 2, axis=0))
    if size.min() < 1e-12:
        return False, np.inf
    normal = np.linalg.pinv((columns / size).T @ (columns / size))
    estimate = normal @ ((columns / size).T @ velocity[good]) / size
    noise_sd = np.sqrt(np.mean((velocity[good] - columns @ estimate) ** 2))
    error = noise_sd * np.sqrt(np.diag(normal) * good.sum() / max(dof, 4.0)) / size
    limit = np.array([settings.velocity_scale * size[1], settings.velocity_scale, settings.velocity_lag])
    return bool(np.all(np.abs(estimate - [0.0, 1.0, 0.0]) + 2 * error < limit)), float(noise_sd)
