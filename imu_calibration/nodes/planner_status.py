"""Diagnostics of planner_node: state of the drive, parameters outside their tolerance, faults."""

from imu_calibration.nodes.diagnostics import ERROR, OK, WARN, make_status
from imu_calibration.nodes.planner_worker import PlannerWorker
from imu_calibration.planning.driver import Driver, DriveState

_LEVELS = {DriveState.STOPPED: ERROR}


def drive_statuses(driver: Driver, worker: PlannerWorker, commands: str, *, faults: list[str]) -> list:
    """Return the DiagnosticStatus of the drive; `commands`: topic or action of the trajectories, `faults`: lines about the inputs."""
    name, excess = worker.worst
    values = {'state': driver.state.value, 'motion': driver.motions, 'of it driven [s]': f'{driver.progress:.1f}',
              'it takes [s]': f'{worker.seconds:.1f}', 'elapsed [s]': f'{worker.elapsed:.1f}', 'outside tolerance': worker.outside,
              'furthest outside': name, 'standard deviation over tolerance': f'{excess:.2f}', 'commands': commands,
              'ignored joint states': ' '.join(f'{name}:{count}' for name, count in driver.ignored.items())}
    if worker.campaign is not None and worker.campaign.findings is not None:
        values |= {'found': ' '.join(finding.effect for finding in worker.campaign.findings),
                   'mates': ' '.join(mate for finding in worker.campaign.findings for mate in finding.mates),
                   'separations': worker.campaign.separations, 'separating': worker.campaign.is_separating,
                   'told apart': ' '.join(worker.campaign.told_apart)}
    text = '; '.join([worker.doing or f'{driver.state}: {driver.reason}', *faults])
    return [make_status(_LEVELS.get(driver.state, WARN if faults else OK), 'drive', text, values=values)]
