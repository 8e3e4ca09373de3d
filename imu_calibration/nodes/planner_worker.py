"""
The thread of planner_node that selects the next motion when the joints rest.

Planning and service calls are slow; the joints are monitored meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from imu_calibration.core.errors import ImuCalibrationError, InputError, shortened
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.nodes.diagnostics import LOG_ERROR, LOG_INFO
from imu_calibration.planning.campaign import Campaign, CollinearFinding
from imu_calibration.planning.driver import Driver, DriveState
from imu_calibration.planning.planner import Decision
from imu_calibration.references.turntable.live_diagnosis import FOUND, MATES_KEY, SIZE_KEY

DRIVER_CHECK_SECONDS = 0.05
"""Seconds between two checks of the driver."""


class Activity(StrEnum):
    """Present activity of the worker, as /diagnostics reports it."""

    NONE = ''
    PLANNING = 'planning'
    DIAGNOSING = 'diagnosing'
    AWAITING_REST = 'waiting until the joints rest'
    AWAITING_STOP = 'waiting for the controller to stop'
    AWAITING_CALIBRATION = 'waiting for the calibration'


@dataclass(frozen=True)
class Peers:
    """Requests of the worker to other nodes; each returns None when no response arrives in time."""

    measure: Callable[[], Any]
    """Returns the calibration (a document) of all data so far."""
    latest: Callable[[], Any]
    """Returns the last calibration that was heard of."""
    diagnose: Callable[[], list[CollinearFinding] | None]
    """Returns the findings of a diagnosis, the strongest first."""
    send: Callable[[Any], None]
    """Sends a trajectory."""
    stop: Callable[[], None]
    """Stops the joints."""
    say: Callable[[str, str], None]
    """Reports (level, line) to the user."""
    obstacle: Callable[[], str] = lambda: ''
    """Returns the reason why no command may be sent at present, '' for none."""


class PlannerWorker(threading.Thread):
    """
    Drives a campaign to its end.

    Parameters
    ----------
    driver : Driver
        Guarded by `lock`: the thread that hears the joint states uses it as well.
    make_campaign : callable
        Returns a new Campaign; runs for seconds.
    peers : Peers
    lock : threading.RLock

    """

    def __init__(
        self, driver: Driver, make_campaign: Callable[[], Campaign], *, peers: Peers, lock: Any
    ):
        super().__init__(name='planner', daemon=True)
        self.driver = driver
        self._make_campaign = make_campaign
        self._peers = peers
        self._lock = lock
        self.campaign: Campaign | None = None
        """Selects the motions; None before the first request."""
        self.doing = Activity.NONE
        """Present activity."""
        self.motion: Any = None
        """The motion that is driven, or was driven last."""
        self.seconds = 0.0
        """Expected duration of the present activity, s."""
        self.worst: tuple[str, float] = ('', 0.0)
        """Parameter furthest outside its tolerance: (name, standard deviation over tolerance)."""
        self.outside = 0
        """Parameters outside their tolerance."""
        self._n_wanted = 0
        """Requested motions that are not completed; -1: all that are needed, 0: none."""
        self._wake = threading.Event()
        """Set to check at once instead of after `DRIVER_CHECK_SECONDS`."""
        self._ending = False
        """Whether the thread ends."""
        self._began_at: float | None = None
        """Time of the first motion since the last start, s of `stamp`; None before it."""
        self.stamp: Callable[[], float] = time.monotonic
        """Seconds by which the time limit counts."""

    @property
    def elapsed(self) -> float:
        """Seconds since the first motion of the campaign began."""
        return 0.0 if self._began_at is None else self.stamp() - self._began_at

    def go(self, motions: int) -> None:
        """Make so many motions from now on; -1: all that are needed."""
        with self._lock:
            if self.driver.state in (DriveState.STOPPED, DriveState.DONE) or motions < 0:
                self.driver.start()
            if motions < 0 and self.campaign is not None and self._n_wanted == 0:
                self._began_at = None  # a new start has its own time
        self._n_wanted = motions
        self._wake.set()

    def halt(self, why: str) -> None:
        """Stop at once."""
        self._n_wanted = 0
        with self._lock:
            self.driver.stop(why)
        self._peers.stop()

    def end(self, timeout: float = 10.0) -> None:
        """End the thread, and stop the joints."""
        self._ending = True
        self._wake.set()
        if self.driver.is_driving:
            self.halt('the node is ending')
        if self.is_alive():
            self.join(timeout)

    def run(self) -> None:
        """Work until `end`."""
        while not self._ending:
            self._wake.wait(DRIVER_CHECK_SECONDS)
            self._wake.clear()
            if self._n_wanted and not self.driver.is_driving:
                try:
                    self._next()
                except ImuCalibrationError as error:
                    self._give_up(str(error))
                except Exception as error:  # a failure must not end the supervision of the joints
                    self._give_up(
                        f'planning failed: {shortened(f"{type(error).__name__}: {error}", 200)}'
                    )
                self.doing = Activity.NONE

    def _give_up(self, why: str) -> None:
        """Stop the joints and discard the request, and report the reason."""
        if self.driver.state is not DriveState.STOPPED:
            self.halt(why)
        self._n_wanted = 0
        self._peers.say(LOG_ERROR, why)

    def _next(self) -> None:
        """Measure after the last motion, then plan and begin the next one."""
        if self.driver.state is DriveState.STOPPED:  # because of the joint states
            self._n_wanted = 0
            return
        if self.campaign is None:
            self.doing = Activity.PLANNING
            self.campaign = self._make_campaign()
        self._wait_for_rest()
        if self.driver.state is DriveState.MEASURING:
            self._measure()
        # The campaign may require a diagnosis before it can choose a motion.
        decision = self._decide()
        while decision is not None and decision.diagnose:
            self.doing = Activity.DIAGNOSING
            self._peers.say(LOG_INFO, f'{decision.why}; diagnosing')
            report = self.campaign.take_findings(self._peers.diagnose())
            if report:
                self._peers.say(LOG_INFO, report)
            calibration = self._peers.latest()
            if calibration is not None:
                self.campaign.take(calibration)
            decision = self._decide()
        if decision is not None:
            self._carry_out(decision)

    def _wait_for_rest(self) -> None:
        """
        Wait until the joints rest, because a motion is planned from their position.

        After a stop they need a while, and a person may turn them. Raises an InputError when they
        move for longer than the settling patience, or their stamps are faulty.
        """
        patience = self.driver.settings.settling_patience
        end = time.monotonic() + patience
        while self._n_wanted and not self._ending and not self.driver.rests:
            self.doing = Activity.AWAITING_REST
            stamp_fault = self.driver.stamp_fault(time.monotonic())
            if stamp_fault:
                raise InputError(stamp_fault)
            # The patience counts from the stop of the controller.
            if self.driver.awaits_stop and not self.driver.is_silent(time.monotonic()):
                self.doing = Activity.AWAITING_STOP
                end = time.monotonic() + patience
            if time.monotonic() > end:
                raise InputError(
                    f'the joints must rest before a motion begins, they moved for {patience:g} s;'
                    ' find the cause'
                )
            self._wake.wait(DRIVER_CHECK_SECONDS)
            self._wake.clear()

    def _measure(self) -> None:
        """Pass the calibration after a motion to the campaign, and count the motion."""
        self.doing = Activity.AWAITING_CALIBRATION
        calibration = self._peers.measure()
        if calibration is not None:
            # A measurement follows a motion, which the campaign has chosen.
            assert self.campaign is not None
            self.campaign.take(calibration)
        if self._n_wanted > 0:
            self._n_wanted -= 1
        if not self._n_wanted:
            with self._lock:
                if self.driver.state is DriveState.MEASURING:
                    self.driver.wait('rests until the next motion is requested')

    def _decide(self) -> Decision | None:
        """Return the campaign's decision on the next step; None without a request."""
        if not self._n_wanted or self._ending:
            return None
        self.doing = Activity.PLANNING
        # Motions are wanted only after the campaign is made, at a known position.
        assert self.campaign is not None and self.driver.position is not None
        decision = self.campaign.decide(self.driver.position, self.elapsed)
        self.worst = self.campaign.worst
        self.outside = sum(excess > 1.0 for excess in self.campaign.planner.excess.values())
        return decision

    def _carry_out(self, decision: Decision) -> None:
        """Begin the motion of a decision, or end the campaign where it has none."""
        if decision.motion is None:
            self._n_wanted = 0
            with self._lock:
                self.driver.finish(decision.why)
            self._peers.say(LOG_INFO, f'done after {self.driver.motions} motions: {decision.why}')
            return
        self._wait_for_rest()  # the joints may have been turned during planning
        obstacle = self._peers.obstacle()
        if obstacle:
            raise InputError(obstacle)
        with self._lock:
            if not self._n_wanted:  # stopped meanwhile
                return
            # Joints that rest have a position.
            assert self.driver.position is not None
            points = self.driver.begin(
                decision.motion.points(self.driver.position),
                decision.motion.words,
                time.monotonic(),
            )
            self.motion = decision.motion
            self.seconds = points.duration
            if self._began_at is None:
                self._began_at = self.stamp()
            self._peers.send(points)
        self._peers.say(
            LOG_INFO,
            f'motion {self.driver.motions}, {points.duration:.0f} s: {decision.motion.words};'
            f' {decision.why}',
        )


def findings_from(values: dict[str, str]) -> list[CollinearFinding]:
    """
    Return the findings of calibration_node's diagnosis, the strongest first.

    Each is an effect with the effects that are collinear with it, and the size of every parameter
    of all of these.

    Parameters
    ----------
    values : dict
        Key -> value of the node's status 'diagnosis'. For an effect E with the collinear mates
        M1 and M2, ``MATES_KEY + E`` -> 'M1 M2', and ``SIZE_KEY + effect.parameter`` -> size of each
        of the three.

    """
    if values.get('outcome') != FOUND:
        return []
    findings = []
    for key, value in values.items():
        if not key.startswith(MATES_KEY):
            continue
        effect = key.removeprefix(MATES_KEY)
        mates = tuple(value.split())
        sizes = {}
        for name in (effect, *mates):
            sizes |= _sizes_of(name, values)
        findings.append(CollinearFinding(effect, mates, sizes))
    return findings


def _sizes_of(effect: str, values: dict[str, str]) -> dict[str, float]:
    """Return parameter of an effect -> its size, from the values of the status 'diagnosis'."""
    prefix = f'{SIZE_KEY}{effect}.'
    sizes = {}
    for key, size in values.items():
        if key.startswith(prefix):
            sizes[key.removeprefix(prefix)] = float(size)
    return sizes
