"""Follows a vehicle in the images of a ROS 2 topic (mono8, as recorded) and publishes where its rear is, on ``lead``:

    python examples/follow_ros2.py --ros-args -r image:=/camera/image_mono -p start:="[597.28, 226.0, 1.0]"

``folder`` holds the camera.yaml and the target.yaml; ``start`` is the target's centre in the first image, px, and its
scale, as `paceline target learn` prints them. Needs a ROS 2 installation.
"""

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

import paceline

UNKNOWN_ANGLE_VARIANCE = 1e6  # rad²: the direction in which the vehicle points is not estimated


class LeadVehicle(Node):
    def __init__(self) -> None:
        super().__init__("lead_vehicle")
        folder = self.declare_parameter("folder", ".").value
        start = self.declare_parameter("start", [0.0, 0.0, 1.0]).value
        camera = paceline.load_camera(f"{folder}/camera.yaml")
        self.tracker = paceline.FollowTracker(camera, paceline.load_target(f"{folder}/target.yaml"), start)
        paceline.warm_up()
        self.frame = 0
        self.publisher = self.create_publisher(PoseWithCovarianceStamped, "lead", 1)
        self.create_subscription(Image, "image", self.update, qos_profile_sensor_data)

    def update(self, message: Image) -> None:
        image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[:, : message.width]
        stamp = message.header.stamp
        estimate = self.tracker.update(image, stamp.sec + 1e-9 * stamp.nanosec, self.frame)
        self.frame += 1
        if estimate.status != "tracking":  # a prediction is no measurement
            self.get_logger().warning(f"{estimate.status}: {estimate.reason}")
            return
        lead = PoseWithCovarianceStamped(header=message.header)  # in the camera's optical frame
        lead.pose.pose.position.x, lead.pose.pose.position.y, lead.pose.pose.position.z = estimate.position.tolist()
        lead.pose.covariance = np.diag([*estimate.position_std**2, *[UNKNOWN_ANGLE_VARIANCE] * 3]).ravel().tolist()
        self.publisher.publish(lead)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(LeadVehicle())
