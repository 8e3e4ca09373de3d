"""
Calibration and compensation of inertial measurement units.

This page fixes the conventions. If code and this page disagree, one of them is a bug.

Frames
------
``s`` sensor (the frame_id of the message), ``b`` body, ``n`` local level with z up, ``i`` inertial.
A vector ends in its frame (``force_s``); a matrix reads target-source (``force_s = mat_sn @
force_n``). All frames are right-handed. The table's base frame, turned so that ``up`` becomes z, is
``n``.

Signs
-----
``rate_s`` is the turn of ``s`` against ``i``, expressed in ``s``; rotation vectors turn
counter-clockwise seen from the tip. ``force_s`` is the specific force: at rest, z up, the
accelerometer reads +g.

Measurement equation
--------------------
``measured = bias + matrix @ (true + lever-arm terms) + further effects``, for both sensors. The
lever arm points from the reference point to the sensitive point: ``f_point = f_ref + alpha x r +
omega x (omega x r)``.

Units and time
--------------
SI and radians inside; different units only with the unit in the name (``temperature_c``,
``bias_deg_h``). ``stamp_ns`` is an integer header stamp; ``time`` is float seconds since the
session's first sample. Ranges are half open.

Shapes
------
Time first: ``(n, 3)``, stacks ``(n, 3, 3)``. A parameter vector or covariance travels with its
``param_names``.

In a notebook
-------------
::

    import imu_calibration as imu
    found = imu.calibrate('session.bag', 'table.yaml')      # without a table: by hand

`load`, `calibrate`, `check`, `compensate`, `diagnose`, `inspect`, `noise` and `simulate` suffice;
their results print, draw and save themselves. Arrays take the place of a recording:
``imu.check(calibration=found.calibration, time=t, force=f, rate=w)``.

Contents
--------
From the lowest layer; each package imports only packages above it in this list. docs/glossary.md
explains the terms.

================  ==================================================================================
`core`            samples, units, settings, errors, documents, probabilities
`kinematics`      table and joints become attitude, rate, angular acceleration, specific force;
                  strapdown integration
`effects`         the catalogue of physical effects, and the sensor model made of it
`preprocessing`   a stream becomes windows: static poses, spins, dynamic stretches; checks of a
                  recording
`estimation`      what solutions have in common: noise, likelihood, least squares, model error
`simulation`      the model run: profiles of motion, noise, sessions
`compensation`    the model inverted: corrected samples with their covariance
`selection`       choice of the effects that the data support, by evidence on held-out data
`allan`           the noise of an IMU at rest: Allan curves, their fit with intervals, noise.yaml
`document`        the calibration file, its verdict, comparison, and conversion to formats of other
                  programs
`calibration`     from observations of any reference to a judged document; options, live sessions,
                  diagnosis
`references`      turntable and gravity: what each gathers, its rows, solution and search, held-out
                  data, live sessions; fleets on tables
`between_imus`    the arm between two IMUs
`planning`        choice of motions, a lower bound on the time of all plans, execution with stops
                  and their reason
`report`          HTML reports
`api`             from files to files: functions of the command line and of notebooks
`cli`, `nodes`    the command line and the ROS 2 nodes; the package `msg_adapters` handles messages
                  and bags
================  ==================================================================================
"""

# The name that type checkers regard as true; ``typing`` would need most of the time of this import
TYPE_CHECKING = False
if TYPE_CHECKING:
    from imu_calibration.api.notebook import (
        calibrate,
        check,
        compensate,
        diagnose,
        inspect,
        load,
        noise,
        simulate,
    )

__all__ = [
    'calibrate',
    'check',
    'compensate',
    'diagnose',
    'inspect',
    'load',
    'noise',
    'simulate',
]
__version__ = '0.1.0'


def __getattr__(name: str) -> object:
    """
    Import the names of `__all__` at their first use (PEP 562).

    The package itself is quick to import and free of ROS.
    """
    if name not in __all__:
        raise AttributeError(f"module 'imu_calibration' has no attribute '{name}'")
    from imu_calibration.api import notebook

    return getattr(notebook, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
