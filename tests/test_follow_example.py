"""The ROS 2 node among the examples, with stand-ins for what ROS provides."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tiny_chase

EXAMPLE = Path(__file__).parents[1] / "examples" / "follow_ros2.py"


class StandInNode:
    """What the example uses of rclpy's Node: its parameters are given, what it publishes and logs is kept."""

    parameters: dict[str, Any] = {}

    def __init__(self, name: str) -> None:
        self.messages: list[Any] = []
        self.logged: list[str] = []

    def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind: object, topic: str, depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=self.messages.append)

    def create_subscription(self, kind: object, topic: str, update: object, qos: object) -> None:
        pass

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.logged.append)


def stand_in_pose(header: object) -> SimpleNamespace:
    return SimpleNamespace(header=header, pose=SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace())))


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    tiny_chase.write(tmp_path, 2)
    start = tiny_chase.start(0)
    monkeypatch.setattr(
        StandInNode, "parameters", {"folder": str(tmp_path), "start": [*start["center"], start["scale"]]}
    )
    modules: dict[str, dict[str, object]] = {
        "rclpy": {}, "rclpy.node": {"Node": StandInNode}, "rclpy.qos": {"qos_profile_sensor_data": None},
        "geometry_msgs": {}, "geometry_msgs.msg": {"PoseWithCovarianceStamped": stand_in_pose},
        "sensor_msgs": {}, "sensor_msgs.msg": {"Image": object},
    }  # fmt: skip
    for name, attributes in modules.items():
        module = ModuleType(name)
        module.__dict__.update(attributes)
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(EXAMPLE))["LeadVehicle"]()


def message(frame: int, image: np.ndarray) -> SimpleNamespace:
    """As ROS sends it, with rows that are longer than the image is wide."""
    rows = np.pad(image, ((0, 0), (0, 8)))
    stamp = SimpleNamespace(sec=1_700_000_000 + frame // 15, nanosec=int(1e9 * (frame % 15) / 15))
    header = SimpleNamespace(stamp=stamp, frame_id="camera_optical")
    return SimpleNamespace(data=rows.tobytes(), height=242, width=256, step=264, header=header)


def test_the_node_publishes_what_is_measured_alone(node: Any) -> None:
    for k in range(6):
        node.update(message(k, tiny_chase.picture(k)))
    node.update(message(6, np.zeros((242, 256), np.uint8)))
    assert len(node.messages) == 6
    (warning,) = node.logged
    assert warning.startswith("coasting: ")
    for k, lead in enumerate(node.messages):
        position = lead.pose.pose.position
        assert np.abs(np.array([position.x, position.y, position.z]) - tiny_chase.truth(k)).max() < 0.15
        covariance = np.array(lead.pose.covariance).reshape(6, 6)
        assert 0 < covariance[2, 2] < 0.1 < covariance[5, 5] and np.count_nonzero(covariance) == 6
        assert lead.header.frame_id == "camera_optical"


def test_the_example_is_short() -> None:
    code = EXAMPLE.read_text(encoding="utf-8").split('"""')[2]
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
