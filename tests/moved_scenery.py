"""Grey patches with a target's box on them, moved about in noise."""

import cv2
import numpy as np

from paceline.cameras import Camera
from paceline.targets.line_model import Target

TARGET = Target(
    "rear",
    10.0,
    np.array([[-0.9, -0.7], [0.9, -0.7], [0.9, 0.7], [-0.9, 0.7]]),
    np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
)
REACH = np.array([9.0, 14.0])


def camera(size, focal, distortion=()):
    width, height = size
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(size, K, np.array(distortion)) if len(distortion) else Camera(size, K)


def scenery(size, seed):
    """A picture (H, W) of grey patches of several sizes."""
    rng = np.random.default_rng(seed)
    noise = sum(cv2.GaussianBlur(rng.normal(0, s, size[::-1]), (0, 0), s) for s in (2.0, 5.0))
    return 120 + 30 * noise / noise.std()


def moved(scene, center, shift, grown, noise, seed):
    """The scene with what is at ``center`` moved by ``shift`` px and ``grown``, and with noise."""
    turn = np.array([[grown, 0, center[0] + shift[0] - grown * center[0]], [0, grown, 0.0]])
    turn[1, 2] = center[1] + shift[1] - grown * center[1]
    image = cv2.warpAffine(scene, turn, scene.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    image += np.random.default_rng(seed).normal(0, noise, scene.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
