"""plan.yaml: motions with angles, rates and seconds, predicted standard deviations, and the ratio to the lower bound of the time."""

from __future__ import annotations

from typing import Any

import numpy as np

from imu_calibration.planning.motions import PlannedMotion
from imu_calibration.planning.planner import Plan
from imu_calibration.planning.situation import PROBABILITY
from imu_calibration.reference.trajectory_points import TrajectoryPoints

FORMAT = 'imu_calibration/plan/1'


def plan_to_mapping(plan: Plan, provenance: dict[str, Any]) -> dict[str, Any]:
    """Return the content of plan.yaml: plain data in SI, except angles of joints in degrees, named so."""
    begins = np.concatenate([[0.0], plan.ends[:-1]]) if len(plan.ends) else []
    return {
        'format': FORMAT,
        'seconds': round(plan.seconds, 3),
        'lower_bound_seconds': None if np.isnan(plan.lower_bound_seconds) else round(plan.lower_bound_seconds, 3),
        'probability': PROBABILITY,
        'joints': list(plan.motions[0].joint_names) if plan.motions else [],
        'motions': [_motion(motion, float(begin), float(end)) for motion, begin, end in zip(plan.motions, begins, plan.ends, strict=True)],
        'parameters': {name: {'sd': float(f'{plan.sd[k]:.6g}'), 'tolerance': float(f'{plan.tolerances[k]:.6g}'),
                              'met': name not in plan.missing} for k, name in enumerate(plan.model.param_names) if plan.wanted[k]},
        'missing': list(plan.missing),
        'provenance': provenance,
    }


def _motion(motion: PlannedMotion, begin: float, end: float) -> dict[str, Any]:
    turns = motion.limits.turns
    units = np.where(turns, 180.0 / np.pi, 1.0)
    rates = [segment.rate_to for segment in motion.segments if segment.kind == 'spin']
    found = {'kind': str(motion.kind), 'text': motion.words, 'begins': round(begin, 3), 'ends': round(end, 3),
             'seconds': round(motion.seconds, 3), 'place_deg_or_m': np.round(motion.place * units, 4).tolist()}
    if rates:
        found['rates_deg_s_or_m_s'] = np.round(np.array(rates) * units, 4).tolist()
    return found


def trajectory_to_mapping(points: TrajectoryPoints) -> dict[str, Any]:
    """Return a trajectory as the fields of trajectory_msgs/JointTrajectory, as ``ros2 topic pub`` reads them."""
    columns = {'positions': points.position, 'velocities': points.rate, 'accelerations': points.acceleration}
    rows = []
    for k, time in enumerate(points.time):
        seconds, nanoseconds = divmod(round(float(time) * 1e9), 1_000_000_000)
        rows.append({name: [float(f'{value:.9g}') for value in values[k]] for name, values in columns.items() if values is not None}
                    | {'time_from_start': {'sec': seconds, 'nanosec': nanoseconds}})
    return {'joint_names': list(points.joint_names), 'points': rows}
