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
SI and radians inside; other units only in names that say so (``temperature_c``, ``bias_deg_h``). ``stamp_ns`` is an
integer header stamp; ``time`` is float seconds since the session's first sample. Ranges are half open.

Shapes
------
Time first: ``(n, 3)``, stacks ``(n, 3, 3)``. A parameter vector or covariance travels with its ``param_names``.
"""

__version__ = '0.1.0'
