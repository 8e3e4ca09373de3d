"""Progress of a calibration by hand: poses, attitudes and turns so far, and the missing direction or motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imu_calibration.calibration.advice import HandKnowledge, foretold, knowledge_after, knowledge_at_first, ups_of
from imu_calibration.calibration.coverage import DIRECTIONS, Coverage, Progress, Step
from imu_calibration.calibration.hand_workflow import HandResult
from imu_calibration.core.errors import with_hint
from imu_calibration.core.progress import LiveState
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.solution import COMMON_SCALE, LACKING, tolerances_of
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.gravity.equations import Poses
from imu_calibration.references.gravity.hand_calibration import MIN_ATTITUDES, POSES_FULL
from imu_calibration.references.gravity.hand_parameters import HandModel, HandOptions
from imu_calibration.references.gravity.poses import average_poses, collect_turns, distinct_attitudes

FACE_DIRECTIONS = {f'{sign}{axis}': direction for axis, unit in zip('xyz', np.eye(3)) for sign, direction in (('+', unit), ('-', -unit))}
"""The six directions that can be turned up."""
FACE_REACH = np.pi / 4
"""A face counts as seen when an attitude lies within this angle of it, rad."""


@dataclass(frozen=True, eq=False)
class PoseScan:
    """Result of the search for rest in the samples so far."""

    rests: list
    """Ranges at rest (slice)."""
    poses: Poses | None
    """Their means; None without any rest."""
    attitudes: int
    """Number of different attitudes."""
    turns: int
    """Number of usable turns between consecutive poses."""
    dropped: dict
    """Reason -> number of unusable turns."""
    resting: float
    """Duration of the current rest, s; 0 in motion."""


EMPTY_SCAN = PoseScan([], None, 0, 0, {}, 0.0)


def look_for_poses(imu: ImuSamples, windows: WindowSettings) -> PoseScan:
    """Return the PoseScan in ImuSamples with rising stamps."""
    rests = [rest for rest in find_still(imu, windows) if rest.stop - rest.start >= 2]
    if not rests:
        return EMPTY_SCAN
    seconds = 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    poses = average_poses(imu, [(rest.start, rest.stop) for rest in rests])
    turns, dropped = collect_turns(seconds, imu, poses=poses)
    goes_on = seconds[-1] - seconds[rests[-1].stop - 1] <= 0.1
    resting = float(seconds[-1] - seconds[rests[-1].start]) if goes_on else 0.0
    return PoseScan(rests, poses, distinct_attitudes(poses.force), len(turns), dropped, resting)


def hand_status(found: PoseScan, calibration: Calibration | None, *, step: str,
                hints: dict[str, str] | None = None) -> LiveState:
    """
    Return the LiveState.

    Parameters
    ----------
    found : PoseScan
    calibration : Calibration or None
        The last solution.
    step : str
        Next step in the planner's text (`advice`), '' when no pose has a gain.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    not_seen = unseen(found)
    word, needs = _needs(found, not_seen, calibration, step=step, hints=hints or {})
    values = {'poses': len(found.rests), 'attitudes': found.attitudes, 'turns': found.turns,
              **{f'turns left out: {reason}': count for reason, count in found.dropped.items()},
              'directions of gravity not seen': ' '.join(not_seen), 'at rest for [s]': f'{found.resting:.1f}', 'next': '; '.join(needs)}
    parts = [f'{_plural(len(found.rests), "pose")} in {_plural(found.attitudes, "attitude")}, {_plural(found.turns, "turn")}']
    if found.dropped:
        parts.append('turns left out: ' + ', '.join(f'{count} {reason}' for reason, count in sorted(found.dropped.items())))
    if found.resting:
        parts.append(f'at rest for {found.resting:.1f} s: this pose counts, move on')
    parts += [f'next: {need}' for need in needs] if needs else ['all parameters are determined: save the calibration']
    return LiveState(word, '; '.join(parts), values)


def unseen(found: PoseScan) -> list[str]:
    """Return the faces ('+x', ...) that have not been up, the one furthest from all attitudes first."""
    if found.poses is None:
        return list(FACE_DIRECTIONS)
    up = unit_rows(found.poses.force)
    nearest = {name: float(np.arccos(np.clip(up @ face, -1, 1)).min()) for name, face in FACE_DIRECTIONS.items()}
    return sorted((name for name, angle in nearest.items() if angle > FACE_REACH), key=lambda name: -nearest[name])


def _needs(found, not_seen, calibration, *, step, hints):
    if found.attitudes < MIN_ATTITUDES or calibration is None:
        more = f' (faces not seen yet: {", ".join(not_seen)})' if not_seen else ''
        return Progress.WAITING, [f'{step}{more}; {MIN_ATTITUDES} attitudes at least, {POSES_FULL} for all parameters']
    lacking = [name for name, status in calibration.status_by_name.items() if status in LACKING]
    if not lacking:
        return Progress.DETERMINED, []
    if lacking == [COMMON_SCALE]:
        return Progress.WEAK, [with_hint('give the local gravity, which scales the accelerometer as a whole', 'gravity', hints)]
    return Progress.WEAK, [step] if step else list(dict.fromkeys(item['needs'] for item in calibration.undetermined))


def _plural(count, noun):
    return f'{count} {noun}' + ('' if count == 1 else 's')


def knowledge_of(found: PoseScan, result: HandResult | None, options: HandOptions) -> HandKnowledge:
    """Return the HandKnowledge of a session: before the first solution from its poses, then from the solution."""
    if result is not None:
        return knowledge_after(result.hand)
    model = HandModel(SensorModel(options.accelerometer or BASE, options.gyroscope or BASE, catalogue=options.catalogue), options.gravity)
    return knowledge_at_first(model, tolerances_of(model.model, options.tolerances), poses=found.poses)


def hand_coverage(found: PoseScan, result: HandResult | None, options: HandOptions, *, frame_id: str = '') -> Coverage:
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
