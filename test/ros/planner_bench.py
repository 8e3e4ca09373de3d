"""
planner_node over DDS in the test's process.

With the joints, the controller and calibration_node of the test.
"""

import json
import time
from functools import partial

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from imu_calibration.nodes.inputs import output_qos
from imu_calibration.nodes.planner_node import PlannerNode

from ros.one_process import OneProcess

NAMES = ['outer', 'inner']
LIMITED = {'range_deg': [-170, 170], 'speed_deg_s': 100.0, 'acceleration_deg_s2': 300.0}
PERIOD = 0.02


class PlannerBench(OneProcess):
    """
    A table of two axes at rest, whose joint states carry the clock of the test.

    Parameters
    ----------
    monkeypatch : pytest.MonkeyPatch
    folder : path-like
        For the table file.
    limits : mapping
        Keys of both joints in the table file.
    parameters : mapping
        Of planner_node.

    """

    def __init__(self, monkeypatch, folder, limits=LIMITED, **parameters):
        super().__init__(monkeypatch)
        self.table_file = folder / 'table.yaml'
        joints = [
            {'name': name, 'axis': axis} | dict(limits)
            for name, axis in zip(NAMES, ([0, 0, 1], [1, 0, 0]), strict=True)
        ]
        self.table_file.write_text(json.dumps({'joints': joints, 'gravity': 9.81}))
        self.stamp, self.position, self.rate, self.trajectories = 100.0, np.zeros(2), [], []
        self.publisher = self.node.create_publisher(JointState, 'joint_states', output_qos())
        self.node.create_subscription(
            JointTrajectory, 'joint_trajectory', self.trajectories.append, 10
        )
        for what in ('solve', 'diagnose'):
            self.node.create_service(Trigger, f'/calibration_node/{what}', self._no)
        self.node.create_publisher(String, 'imu/calibration', 10)
        self.planner = self.start(PlannerNode, {'table_file': str(self.table_file), **parameters})
        self.until(
            lambda: self.publisher.get_subscription_count() == 1 and self.planner._command.is_heard,
            'the connection',
        )

    def _no(self, _, response):
        response.success, response.message = False, 'too little motion'
        return response

    def look(self, elapsed=PERIOD, **fields):
        """Publish a joint state so much later, and let everything be heard."""
        self.stamp += elapsed
        if elapsed:
            self.advanced_at = time.monotonic()
        message = JointState(
            name=NAMES,
            position=[float(value) for value in self.position],
            velocity=list(self.rate),
            **fields,
        )
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            round(self.stamp * 1e9), 1_000_000_000
        )
        self.publisher.publish(message)
        self.executor.spin_once(timeout_sec=0.005)

    def looks(self, condition, what, elapsed=PERIOD):
        """Publish joint states until a condition holds."""

        def step():
            self.look(elapsed)
            return condition()

        self.until(step, what)

    def ask(self, what, elapsed=PERIOD):
        """Call a service of the planner while joint states go on."""
        return self.call(f'/planner_node/{what}', until=partial(self.looks, elapsed=elapsed))

    def moving(self, **parameters):
        """Start and return once a motion is driven."""
        self.looks(lambda: self.planner.driver.position is not None, 'the joints')
        answer = self.ask('start')
        assert answer.success, answer.message
        self.looks(lambda: any(message.points for message in self.trajectories), 'a motion')
        return self

    def set(self, node='planner_node', **values):
        """Set parameters of a node from outside; return the results."""
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        return self.call(f'/{node}/set_parameters', SetParameters, parameters=parameters).results
