"""A bench for the simulated driver: a driver whose slices the test asks for, a helper that talks to it."""

import os
import random
import threading
import time

# Read when rclpy is initialised: other ROS programs neither disturb the tests nor hear them.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 100))

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.franka_driver import FrankaDriver


class Cell:
    """A driver whose slices the test asks for, and a helper that talks to it."""

    def __init__(self, namespace="", **overrides):
        given = [Parameter(key.replace("__", "."), value=value) for key, value in overrides.items()]
        given.append(Parameter("real_time_factor", value=100.0))
        self.driver = FrankaDriver("franka_driver", namespace=namespace, parameter_overrides=given)
        self.helper = rclpy.create_node("driver_helper", namespace=namespace)
        self.executor = rclpy.executors.SingleThreadedExecutor()
        for node in (self.driver, self.helper):
            self.executor.add_node(node)
        self.received = {}
        self.driver.start()
        self.commands = self.helper.create_publisher(JointTrajectory, "joint_trajectory", 1)
        self.hand = self.helper.create_publisher(WrenchStamped, "disturbance", 5)

    def listen(self, kind, topic):
        self.received[topic] = []
        self.helper.create_subscription(kind, topic, self.received[topic].append, qos_profile_sensor_data)

    def connect(self):
        topics = ["joint_trajectory", "disturbance", *self.received]
        end = time.monotonic() + 5.0
        while time.monotonic() < end and not all(self.helper.count_publishers(self.full(t)) for t in topics):
            self.executor.spin_once(timeout_sec=0.02)
        self.spin(0.1)

    def full(self, topic):
        return topic if topic.startswith("/") else f"{self.helper.get_namespace().rstrip('/')}/{topic}"

    def spin(self, seconds=0.01):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.001)

    def advance(self, duration):
        for _ in range(round(duration / 0.005)):
            self.driver.advance()
            for _ in range(10):  # more messages than a slice sends to one reader
                self.executor.spin_once(timeout_sec=0.0002)

    def send(self, message, wait=0.02):
        self.commands.publish(message)
        self.spin(wait)
        self.advance(0.005)

    def counts(self):
        return self.driver.complaints.counts

    def close(self):
        self.executor.shutdown()
        self.driver.destroy_node()
        self.helper.destroy_node()


def call(cell, kind, name, request):
    """Services are answered by the main thread between slices, so both threads are needed."""
    stop = threading.Event()

    def physics():
        while not stop.is_set():
            cell.driver.advance()

    thread = threading.Thread(target=physics)
    client = cell.helper.create_client(kind, name)
    thread.start()
    try:
        assert client.wait_for_service(5.0)
        future = client.call_async(request)
        cell.executor.spin_until_future_complete(future, timeout_sec=5.0)
    finally:
        stop.set()
        thread.join()
    return future.result()
