"""
The picture of a session: worth by information, not by visits; the arrow leads to what helps.

A person who follows only the picture gets there.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.calibration.coverage import (
    DIRECTIONS,
    MIN_CELL_WORTH,
    Coverage,
    Step,
    label_of,
)
from imu_calibration.calibration.live import LiveByHandSettings, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.outcome import parameter_count
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.estimation.solution import (
    DRIFT,
    EXCESS_REMEDY,
    MODEL_ERROR,
    REJECTED,
    REMEDIES,
)
from imu_calibration.references.gravity.advice import (
    WEIGHTS,
    HandStep,
    _rollout,
    direction_words,
    foretold,
    shortest_turn,
)
from imu_calibration.references.gravity.hand_parameters import HandOptions
from imu_calibration.references.gravity.live_poses import (
    EMPTY_SCAN,
    LiveByHand,
    hand_coverage,
    knowledge_of,
)
from imu_calibration.references.turntable.standard_motions import MOTIONS, motions_about
from imu_calibration.references.turntable.table_coverage import table_coverage

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY
from worlds.person import Person

ROOT = Path(__file__).resolve().parents[2]
OPTIONS = HandOptions(gravity=GRAVITY)


def start():
    """What is known before anything came."""
    return hand_coverage(EMPTY_SCAN, None, OPTIONS)


def knowing(*ups, factor=1.0):
    """Knowledge after rests with some directions up, in order."""
    knowledge = knowledge_of(EMPTY_SCAN, None, OPTIONS)
    for up in ups:
        up = np.array(up, float) / np.linalg.norm(up)
        knowledge = knowledge.then(HandStep(up))
    return replace(knowledge, information=factor * knowledge.information)


def test_the_shortest_turn_brings_the_wanted_direction_up():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(2)
    for _ in range(20):
        now, wanted = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        axis, angle = shortest_turn(now, wanted)
        # What was up in the sensor frame turns backwards when the sensor turns forwards.
        np.testing.assert_allclose(
            Rotation.from_rotvec(axis * angle).inv().apply(now), wanted, atol=1e-12
        )
    axis, angle = shortest_turn(np.array([0, 0, 1.0]), np.array([0, 0, -1.0]))
    assert angle == pytest.approx(np.pi) and axis[2] == pytest.approx(0)


def test_at_first_everything_is_worth_having_and_the_time_is_foretold():
    found = start()
    assert (found.worth[DIRECTIONS[:, 2] < 0.9] > 0).all() and found.next.up is not None
    assert 40 <= found.seconds <= 90
    assert not found.done and not len(found.seen)


def test_what_has_been_held_many_times_is_worth_less_than_what_has_not():
    knowledge = knowing(*[(1, 0, 0), (0, 1, 0)] * 10, (0, 0, 1))
    worth = dict(
        zip(
            map(tuple, np.sign(DIRECTIONS).astype(int).tolist()),
            knowledge.best().gains,
            strict=True,
        )
    )
    assert max(worth[1, 0, 0], worth[0, 1, 0]) < 0.5 * worth[-1, 0, 0]


def test_an_attitude_that_nobody_took_is_worth_nothing_once_everything_is_known():
    ups = [d for d in DIRECTIONS if d[2] > -0.9]
    enough = knowing(*ups, *ups, factor=10.0)
    worth = enough.best().gains
    assert foretold(enough) == [] and (worth < MIN_CELL_WORTH).all()


def test_what_is_foretold_takes_off_what_is_missing():
    knowledge, steps = knowing((0, 0, 1)), foretold(knowing((0, 0, 1)))
    assert 8 <= len(steps) <= 20
    # Neither way of choosing is sooner at its end than what is foretold.
    hasty = [_rollout(knowing((0, 0, 1)), weight)[0] for weight in WEIGHTS]
    assert (
        sum(step.seconds for step in steps)
        == min(sum(step.seconds for step in plan) for plan in hasty)
        < max(sum(s.seconds for s in p) for p in hasty)
    )
    before = float(knowledge.excess(knowledge.information))
    for step in steps:
        knowledge = knowledge.then(step)
        after = float(knowledge.excess(knowledge.information))
        assert after < before
        before = after
    assert before == 0


def by_the_picture(person, most=40):
    """(seconds planned, Coverage in the end) of a person who looks at nothing but the picture."""
    options = CalibrationOptions(catalogue=CATALOGUE.with_candidates(FEW))
    live = LiveByHand(
        options, LiveSettings(), LiveByHandSettings(gravity=GRAVITY), clock=lambda: 0.0
    )
    planned = live.coverage().seconds
    live.push(SampleBlock(person.hold()))
    for _ in range(most):
        shown = live.coverage()
        if live.result is not None and set(live.result.applied.statuses) == {'determined', 'fixed'}:
            break
        live.push(SampleBlock(person.go(shown.next.axis, shown.next.angle)))
        try:
            live.solve(pending=True)
        except NotObservableError:
            pass
    return planned, shown


@pytest.mark.long
@pytest.mark.slow
def test_who_follows_only_the_picture_has_everything_determined_in_time():
    person = Person(1)
    planned, shown = by_the_picture(person)
    assert not shown.next.text and shown.seconds == 0
    assert person.seconds <= 1.3 * planned


def test_on_a_table_the_picture_shows_what_the_motion_did():
    found = calibrate_recordings(
        [str(ROOT / 'bags/sample_session')],
        str(ROOT / 'bags/sample_session/table.yaml'),
        model_as_asked=True,
    )
    shown = table_coverage(found.result, 'imu_link')
    assert shown.worth.shape == (26,) and (shown.worth >= 0).all() and (shown.worth <= 1).all()
    assert len(shown.seen) > 4 and np.allclose(np.linalg.norm(shown.seen, axis=1), 1)
    assert bool(shown.next.text) == bool(found.result.needed)


@pytest.fixture(scope='module')
def begun():
    """A table after twenty seconds: (session, result)."""
    from imu_calibration.references.turntable.live_windows import LiveCalibration

    from worlds.live_sessions import OPTIONS as TABLE_OPTIONS
    from worlds.live_sessions import TABLE, make_session

    imu, joints, _, _ = make_session(3, profile='quick')
    live, end = LiveCalibration(TABLE, TABLE_OPTIONS), imu.stamp_ns[0] + 20_000_000_000
    live.push(SampleBlock(imu.select(imu.stamp_ns < end), joints.select(joints.stamp_ns < end)))
    return live, live.solve(pending=True)


def _sd_after(information, prior):
    """By the rows themselves; the gauge as exact as a millionth of a metre."""
    values, vectors = np.linalg.eigh(information)
    gauge = 1e-6 * prior.gauge
    rows = np.concatenate(
        [np.sqrt(np.clip(values, 0, None))[:, None] * vectors.T, np.diag(1 / prior.sd), gauge]
    )
    return np.sqrt((np.linalg.inv(np.linalg.qr(rows)[1]) ** 2).sum(axis=1))


def test_on_a_table_the_seconds_are_those_of_motions_that_leave_nothing(begun):
    """
    What they would add to the information is added, one after the other; the first is the next one.
    """
    from imu_calibration.estimation.prior import make_prior
    from imu_calibration.references.turntable.observability import MotionInformation

    live, result = begun
    shown, solution = live.coverage(), result.solution
    assert (
        result.needed
        and 0 < shown.seconds < 600
        and shown.next.text in {motion.text for motion in MOTIONS}
    )
    assert label_of(shown)[2] == f'{shown.next.text}, about {shown.seconds:.0f} s left'
    lengths, prior, first = (
        {motion.text: motion.seconds for motion in MOTIONS},
        make_prior(solution.model),
        shown.next.text,
    )
    if shown.seconds == pytest.approx(lengths[first]):
        [motion] = [motion for motion in MOTIONS if motion.text == first]
        more = MotionInformation(
            solution.model, solution.values, solution.noise, result.gravity
        ).added_by(motion)
        before, after = (_sd_after(solution.information + each, prior) for each in (0 * more, more))
        sd = after * np.maximum(result.calibration.sd / before, 1)
        assert (sd <= result.tolerances)[np.array(result.model.requested)].all()


def test_a_table_with_one_joint_is_told_no_seconds_of_motions_that_it_cannot_do(begun, monkeypatch):
    live, result = begun
    monkeypatch.setattr(
        'imu_calibration.references.turntable.table_coverage.possible_motions',
        lambda table: motions_about([0.6, 0.0, 0.8], [0.0, 0.0, 1.0]),
    )
    shown = table_coverage(result)
    assert np.isnan(shown.seconds) and shown.next.text and 'left' not in label_of(shown)[2]


def test_on_a_table_the_picture_shows_no_motion_for_an_error_of_the_model(begun):
    """More motions do not help there; the gain of a rest is none."""
    result = begun[1]
    need = REMEDIES[MODEL_ERROR, DRIFT, REJECTED]
    lacking = parameter_count(result.calibration).lacking
    shown = table_coverage(replace(result, needed=dict.fromkeys(lacking, (need, np.nan))))
    assert shown.next.text == need and shown.next.axis is None
    assert not shown.worth.any() and not shown.done and 'left' not in label_of(shown)[2]


def test_the_picture_is_done_without_the_parameters_of_the_table(begun):
    calibration = begun[1].calibration
    status = [
        'weak' if name.startswith('reference.') else 'determined'
        for name in calibration.param_names
    ]
    known = replace(begun[1], calibration=replace(calibration, status=tuple(status)), needed={})
    assert 'weak' in status and table_coverage(known).done and not begun[0].coverage().done


@pytest.mark.parametrize('need', [REMEDIES[MODEL_ERROR, DRIFT, REJECTED], EXCESS_REMEDY])
def test_by_hand_the_picture_shows_no_attitude_that_does_not_help(need):
    weak = {'gyroscope.matrix.xx': 'weak', 'gyroscope.bias.x': 'determined'}
    undetermined = ({'parameters': {'gyroscope.matrix.xx': 2.0}, 'needs': need},)
    calibration = SimpleNamespace(requested=weak, undetermined=undetermined)
    shown = hand_coverage(EMPTY_SCAN, SimpleNamespace(calibration=calibration), OPTIONS)
    assert shown.next.text == need and shown.next.up is None and not shown.worth.any()


def picture(coverage):
    """The markers by name."""
    pytest.importorskip('rclpy')
    from builtin_interfaces.msg import Time

    from imu_calibration.nodes.calibration_status import markers_of

    made = {}
    for marker in markers_of(coverage, Time(sec=3)).markers:
        made.setdefault(marker.ns, []).append(marker)
    return made


def test_markers_carry_frame_cells_arrow_and_time():
    shown, now = start(), np.array([0, 0, 1.0])
    shown = replace(
        shown,
        next=replace(
            shown.next,
            axis=shortest_turn(now, shown.next.up)[0],
            angle=shortest_turn(now, shown.next.up)[1],
        ),
    )
    shown = replace(shown, worth=np.where(DIRECTIONS @ now > 0.9, 0.0, shown.worth))
    made = picture(replace(shown, frame_id='my_imu', seen=np.eye(3), up=now))
    assert {marker.header.frame_id for markers in made.values() for marker in markers} == {
        'my_imu'
    } and made['all'][0].action == made['all'][0].DELETEALL
    assert len(made['cells']) == 26 and len(made['seen'][0].points) == 3 and 'turn' in made
    best = int(np.argmax(shown.worth))
    sizes = [marker.scale.x for marker in made['cells']]
    assert sizes[best] == max(sizes) and min(sizes) < 0.7 * max(sizes)
    tip = made['next'][0].points[1]
    direction = np.array([tip.x, tip.y, tip.z])
    np.testing.assert_allclose(direction / np.linalg.norm(direction), shown.next.up, atol=1e-12)
    assert made['text'][0].text == f'{shown.next.text}, about {shown.seconds:.0f} s left'


def test_when_all_is_done_every_cell_is_green_and_the_text_says_so():
    done = Coverage(np.zeros(26), np.eye(3), np.eye(3)[0], Step(''), 0.0, True, 0.01 * np.eye(3))
    made = picture(done)
    assert (
        made['text'][0].text == label_of(done)[2] and 'next' not in made and len(made['arms']) == 3
    )
    assert (
        len({(m.color.r, m.color.g, m.scale.x) for m in made['cells']}) == 1
        and made['cells'][0].color.g > made['cells'][0].color.r
    )


def test_the_configuration_of_rviz_shows_the_topic_as_it_is_published():
    """
    By the names that rviz_default_plugins and rviz_common declare.

    They are in plugins_description.xml of both.
    """
    import yaml

    known = {
        'rviz_common/Displays',
        'rviz_common/Views',
        'rviz_default_plugins/Axes',
        'rviz_default_plugins/MarkerArray',
        'rviz_default_plugins/MoveCamera',
        'rviz_default_plugins/Orbit',
        '',
    }
    found = yaml.safe_load((ROOT / 'config/coverage.rviz').read_text())

    def classes(part):
        parts = part.values() if isinstance(part, dict) else part if isinstance(part, list) else []
        return ({part['Class']} if isinstance(part, dict) and 'Class' in part else set()).union(
            *map(classes, parts)
        )

    assert classes(found) <= known
    [display] = [
        each
        for each in found['Visualization Manager']['Displays']
        if each['Class'].endswith('MarkerArray')
    ]
    assert (
        display['Topic']['Value'] == '/imu/coverage'
        and display['Topic']['Durability Policy'] == 'Transient Local'
    )
    assert found['Visualization Manager']['Global Options']['Fixed Frame'] == 'imu_link'


def test_the_layout_for_foxglove_shows_picture_parameters_and_residuals():
    """
    As the layout classes of foxglove-sdk 0.30 write it.

    Its names are compared with those of the nodes in test/project/test_package.py.
    """
    import json

    found = json.loads((ROOT / 'config/coverage.foxglove.json').read_text())

    def panels(part):
        if part['type'] == 'panel':
            return [part]
        return [panel for item in part['items'] for panel in panels(item['content'])]

    kinds = {panel['panelType']: panel['config'] for panel in panels(found['content'])}
    assert found['version'] == 1 and set(kinds) == {'ThreeDee', 'DiagnosticsSummary', 'Plot'}
    assert (
        kinds['ThreeDee']['topics'] == {'/imu/coverage': {'visible': True}}
        and kinds['DiagnosticsSummary']['topicToRender'] == '/diagnostics'
    )


def test_the_picture_of_the_readme_can_be_drawn(monkeypatch, tmp_path):
    """The same cells, arrows and lines as docs/coverage.png: nothing else runs the example."""
    pytest.importorskip('rclpy')  # the example draws the markers of a node
    monkeypatch.syspath_prepend(ROOT / 'examples')
    import coverage_picture

    first, on_the_way, last = coverage_picture.states()
    assert (
        first.seconds > on_the_way.seconds > 0
        and direction_words(on_the_way.next.up) in on_the_way.next.text
        and len(on_the_way.seen) == 7
    )
    assert last.done and not last.next.text
