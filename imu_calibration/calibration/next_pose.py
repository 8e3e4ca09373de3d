"""Next attitude of a session by hand: current knowledge, next step, and time until all parameters are determined."""

from __future__ import annotations

import numpy as np

from imu_calibration.calibration.advice import HandKnowledge, foretold, knowledge_after, knowledge_at_first, ups_of
from imu_calibration.calibration.coverage import DIRECTIONS, Coverage, Step
from imu_calibration.calibration.hand_result import HandResult
from imu_calibration.calibration.pose_scan import Findings
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.solution import LACKING, tolerances_of
from imu_calibration.references.gravity.hand_options import HandOptions
from imu_calibration.references.gravity.hand_parameters import HandModel


def knowledge_of(found: Findings, result: HandResult | None, options: HandOptions) -> HandKnowledge:
    """Return the HandKnowledge of a session: before the first solution from its poses, then from the solution."""
    if result is not None:
        return knowledge_after(result.hand)
    model = HandModel(SensorModel(options.accelerometer or BASE, options.gyroscope or BASE, catalogue=options.catalogue), options.gravity)
    return knowledge_at_first(model, tolerances_of(model.model, options.tolerances), options.settings, poses=found.poses)


def hand_coverage(found: Findings, result: HandResult | None, options: HandOptions, *, frame_id: str = '') -> Coverage:
    """Return the Coverage of a session by hand: the cells, the next pose with the turn to it, and the remaining seconds."""
    seen = ups_of(found.poses)
    up = None if found.poses is None else seen[-1]
    knowledge = knowledge_of(found, result, options)
    steps = [] if result is not None and not set(LACKING) & set(result.hand.statuses) else foretold(knowledge)
    if not steps:
        return Coverage(np.zeros(len(DIRECTIONS)), seen, up, Step(''), 0.0, frame_id=frame_id)
    first, worth = steps[0], knowledge.best()[1]
    return Coverage(worth, seen, up, Step(first.words, first.up, first.axis, first.angle), sum(step.seconds for step in steps),
                    frame_id=frame_id)
