"""
Calibration and compensation of inertial measurement units.

This page fixes the conventions. If code and this page disagree, one of them is a bug.

Frames
------
``s`` sensor (the frame_id of the message), ``b`` body, ``n`` local level with z up, ``i`` inertial.
A vector ends in its frame (``force_s``); a matrix reads target-source (``force_s = mat_sn @ force_n``).
All frames are right-handed. The table's base frame, turned so that ``up`` becomes z, is ``n``.

Signs
-----
``rate_s`` is the turn of ``s`` against ``i``, expressed in ``s``; rotation vectors turn counter-clockwise
seen from the tip. ``force_s`` is the specific force: at rest, z up, the accelerometer reads +g.

Measurement equation
--------------------
``measured = bias + matrix @ (true + lever-arm terms) + further effects``, for both sensors. The lever arm points
from the reference point to the sensitive point: ``f_point = f_ref + alpha x r + omega x (omega x r)``.

Units and time
--------------
SI and radians inside; different units only with the unit in the name (``temperature_c``, ``bias_deg_h``). ``stamp_ns`` is an
integer header stamp; ``time`` is float seconds since the session's first sample. Ranges are half open.

Shapes
------
Time first: ``(n, 3)``, stacks ``(n, 3, 3)``. A parameter vector or covariance travels with its ``param_names``.

In a notebook
-------------
::

    import imu_calibration as imu
    found = imu.calibrate('session.bag', 'table.yaml')      # without a table: by hand

`load`, `calibrate`, `check`, `compensate`, `diagnose` and `simulate` suffice; their results print, draw and
saves itself.

Contents
--------
From the lowest layer; each package imports only packages above it in this list. docs/glossary.md explains the terms.

================  ======================================================================================================
`samples`         arrays of samples from a bag or a topic; also constants, units, settings, errors
`reference`       where the IMU truly was: table and joints become attitude, rate, angular acceleration, specific force
`navigation`      strapdown integration: effect of calibration errors in use
`segmentation`    a stream becomes windows: static poses, spins, dynamic stretches
`effects`         the catalogue of physical effects, and the sensor model made of it
`estimation`      windows become a solution: noise, likelihood, least squares, observability
`preflight`       checks of a recording before estimation
`simulation`      the model run: profiles of motion, noise, sessions
`compensation`    the model inverted: corrected samples with their covariance
`allan`           the noise of an IMU at rest: Allan curves, their fit with intervals, noise.yaml
`selection`       choice of the effects that the data support, tested on held-out windows
`beyond`          residuals that no effect of the catalogue explains: size, place and formula
`calibration`     the use case: from recordings to a judged document; live sessions, fleets, comparison
`papers`          Avrutov 2017 and Zhang 2017 as printed, with errata
`planning`        choice of motions: gain per second, and a lower bound on the time of all plans
`driving`         execution of motions: trajectories, monitoring of the joints, stops with their reason
`by_hand`         calibration without a table; the arm between two IMUs
`exports`         conversion of a calibration to and from formats of other programs, with the loss of each
`diagnosis`       errors of the model and their causes
`report`          HTML reports
`files`           atomic writing of files; `resources` finds installed files
`use_cases`       from files to files: functions of the command line and of notebooks
`cli`, `nodes`    the command line and the ROS 2 nodes; the package `msg_adapters` handles messages and bags
`ros2`            the verbs under ``ros2 imu``, and the checks of ``ros2 doctor``
================  ======================================================================================================
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from imu_calibration.use_cases.notebook import calibrate, check, compensate, diagnose, load, simulate

__all__ = ['calibrate', 'check', 'compensate', 'diagnose', 'load', 'simulate']
__version__ = '0.1.0'


def __getattr__(name: str) -> object:
    """Import the names of `__all__` at their first use (PEP 562): the package itself is quick to import and free of ROS."""
    if name not in __all__:
        raise AttributeError(f"module 'imu_calibration' has no attribute '{name}'")
    from imu_calibration.use_cases import notebook
    return getattr(notebook, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
