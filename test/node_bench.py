"""A bench for nodes: one node in simulated time, a helper that talks to it, a clock that the test turns."""

import os
import random
import time

# Read when rclpy is initialised: other ROS programs neither disturb the tests nor hear them.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 100))

import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock

from vpsto_ros.nodes.conversions import SIMULATED


class Bench:
    """A node in simulated time, a helper that talks to it, and a clock that the test turns."""

    def __init__(self, node_class, name, **overrides):
        given = [Parameter(key.replace("__", "."), value=value) for key, value in overrides.items()]
        self.node = node_class(name, parameter_overrides=[Parameter("use_sim_time", value=True), *given])
        self.helper = rclpy.create_node(f"{name}_helper")
        self.executor = rclpy.executors.SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.helper)
        self.publishers = {}
        self.received = {}
        self.clock = self.helper.create_publisher(Clock, "/clock", 10)
        self.time = 0.0
        self.node.start()

    def listen(self, kind, topic):
        self.received[topic] = []
        self.helper.create_subscription(kind, topic, self.received[topic].append, qos_profile_sensor_data)

    def talk(self, kind, topic):
        self.publishers[topic] = self.helper.create_publisher(kind, topic, 10)

    def send(self, topic, message):
        self.publishers[topic].publish(message)

    def connect(self):
        topics = ["/clock", *self.publishers]
        end = time.monotonic() + 5.0
        while time.monotonic() < end and not all(
            self.helper.count_subscribers(t) and self.helper.count_publishers(t) for t in topics
        ):
            self.executor.spin_once(timeout_sec=0.05)
        self.advance(0.05)

    def spin(self, seconds=0.02):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.002)

    def advance(self, duration, each=None, step=0.01):
        for _ in range(round(duration / step)):
            self.time += step
            if each:
                each(self.time)
            self.clock.publish(Clock(clock=SIMULATED.stamp(self.time)))
            self.settle()

    def settle(self):
        """Let the node see the time and do what is due, however slow the host is."""
        now, give_up = round(self.time * 1e9), time.monotonic() + 10.0
        while self.node.get_clock().now().nanoseconds != now and time.monotonic() < give_up:
            self.executor.spin_once(timeout_sec=0.005)
        for _ in range(14):  # more than is ever ready at once
            self.executor.spin_once(timeout_sec=0.0003)

    def stamp(self, offset=0.0):
        return SIMULATED.stamp(self.time + offset)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        self.helper.destroy_node()
