"""How a camera turns while it records, as one on a mast does in the wind: its rotation in each frame against a
reference frame, from the static background.

A camera that only rotates moves the picture of a point x, wherever it lies, to K R K⁻¹ x. Corners of the reference
frame are tracked into each frame, and R is fitted to them robustly (Tukey's weights), so that vehicles do not count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image, Indices, Mask, to_8_bit
from paceline.cameras import Camera
from paceline.imaging.moving_features import reduced
from paceline.imaging.point_tracking import track_forth_and_back
from paceline.imaging.robust_weights import robust_sigma, tukey_weights
from paceline.progress import Progress
from paceline.recordings.stereo import StereoFrame, StereoRecording

MAX_STATIC_CORNERS = 200  # of the reference frame, in each view
CORNER_DISTANCE_PX = 20
STATIC_CORNER_QUALITY = 0.005  # least eigenvalue of a corner's structure, as a share of the best corner's
TRACKING_PRECISION_PX = 0.01
TRACKING_LEVELS = 2  # a picture may move by some ten pixels
MAX_CORNER_RETURN_PX = 0.3  # greatest distance between a corner and where it is tracked back to
MIN_STATIC_CORNERS = 20  # least corners that a rotation is fitted to
MIN_STATIC_SHARE = 0.5  # least share of a frame's corners that a rotation explains: else it is not known
MIN_KNOWN_SHARE = 0.5  # least share of the frames in which it is known: else the camera itself travels
MAX_STATIC_RESIDUAL_PX = 0.5  # of a corner that it explains
MIN_CORNER_RESIDUAL_PX = 0.02  # residuals of tracked corners are at least those of interpolation
# Standard deviation of what all corners of a view have in common beside the rotation: how the mast's foot moves, and
# how the light does; measured on swaying clips with known rotations
COMMON_MOTION_PX = 0.01
SAMPLED_FRAMES = 60  # frames of a long recording that are looked at first
MIN_LOG_ODDS = 3.0  # of a camera that turns over one that does not
ROTATION_FIT_STEPS = 20
EXPOSURE_REDUCTION = 8  # of pictures of which exposures are compared: a turn of some pixels changes little of them
EXPOSURE_FIT_STEPS = 5
MIN_EXPOSURE_RESIDUAL = 0.5  # grey levels
MIN_EXPOSURE_GAIN = 0.05  # of a picture that shows the same as another
CONVERGED_STEP_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class CameraRotations:
    """The rotations of both cameras in N frames against the reference frame.

    ``vectors`` (N, 2, 3) rad are rotation vectors: a point at X in the camera's axes at the reference frame is at R X
    in those of the frame. ``covariance`` is (N, 2, 3, 3) rad². ``static_share`` (N, 2) is the share of the tracked
    corners that are where the rotation puts them, 0 where there are too few or the picture cannot be decoded.
    """

    vectors: Array
    covariance: Array
    static_share: Array

    @property
    def is_known(self) -> Mask:
        """In which frames of which view (N, 2) most corners agree with the rotation."""
        return np.asarray(self.static_share >= MIN_STATIC_SHARE)

    @property
    def is_stationary(self) -> bool:
        """Whether the background is static but for rotations, in most of the frames of both views."""
        return bool((self.is_known.mean(axis=0) >= MIN_KNOWN_SHARE).all())


class ReferenceView:
    """The corners of one camera's reference frame."""

    def __init__(self, camera: Camera, image: Image) -> None:
        self.camera, self.image = camera, to_8_bit(image)
        self._reduced = reduced(image, EXPOSURE_REDUCTION)
        corners = cv2.goodFeaturesToTrack(
            self.image, MAX_STATIC_CORNERS, STATIC_CORNER_QUALITY, CORNER_DISTANCE_PX, blockSize=7
        )
        self.corners = np.zeros((0, 2)) if corners is None else np.asarray(corners[:, 0], float)

    def rotation_in(self, image: Image) -> tuple[Array, Array, float]:
        """The rotation vector (3,) of the camera in ``image`` (H, W), its covariance (3, 3) and the static share."""
        if len(self.corners) < MIN_STATIC_CORNERS:
            return np.zeros(3), np.eye(3), 0.0
        limits = TRACKING_LEVELS, TRACKING_PRECISION_PX, MAX_CORNER_RETURN_PX
        gain, level = exposure_change(self._reduced, reduced(image, EXPOSURE_REDUCTION))
        if gain < MIN_EXPOSURE_GAIN:
            return np.zeros(3), np.eye(3), 0.0
        at_exposure = to_8_bit((image - level) / gain)
        tracked, found = track_forth_and_back(self.image, at_exposure, self.corners, self.corners, *limits)
        if found.sum() < MIN_STATIC_CORNERS:
            return np.zeros(3), np.eye(3), 0.0
        before, after = self.corners[found], tracked[found]
        vector, covariance, _ = fit_rotation(self.camera, before, after)
        distance = np.linalg.norm(after - self.camera.turned(before, vector), axis=1)
        return vector, covariance, float((distance < MAX_STATIC_RESIDUAL_PX).mean())


def exposure_change(before: Image, after: Image) -> tuple[float, float]:
    """The gain and the level (grey levels) by which most of the pixels ``after`` (H, W) are those ``before`` (H, W):
    a robust line (Tukey's weights). Lucas–Kanade takes a change of exposure for a motion, which all corners share.

    As both pictures differ where the camera has turned, the gain is the ratio of their standard deviations (the reduced
    major axis), not the slope by least squares, which would be too small.
    """
    before, after, gain, level = before.ravel().astype(float), after.ravel().astype(float), 1.0, 0.0
    for _ in range(EXPOSURE_FIT_STEPS):
        residual = np.abs(after - gain * before - level)
        weights = tukey_weights(residual, robust_sigma(residual, MIN_EXPOSURE_RESIDUAL))
        weights /= weights.sum()
        means = weights @ before, weights @ after
        variances = weights @ (before - means[0]) ** 2, weights @ (after - means[1]) ** 2
        gain = float(np.sqrt(variances[1] / variances[0])) if variances[0] > 0.0 else 0.0
        level = float(means[1] - gain * means[0])
    return gain, level


def estimate_rotations(
    recording: StereoRecording, reference: StereoFrame, progress: Progress | None = None
) -> CameraRotations:
    """The rotations in all frames of ``recording`` against its frame ``reference``.

    Of a long recording `SAMPLED_FRAMES` are looked at first, spread evenly: cameras that do not turn in any of them, or
    that travel, need no look at the others.
    """
    views = [
        ReferenceView(camera, image)
        for camera, image in zip(recording.rig.cameras, (reference.left, reference.right), strict=True)
    ]
    count = len(recording)
    if count > SAMPLED_FRAMES:
        sample = recording.indices[np.linspace(0, count - 1, SAMPLED_FRAMES).round().astype(np.int64)]
        sampled = _rotations_in(recording.selected(sample), views, sample, progress)
        if not (sampled.is_stationary and expected_rotations(sampled).any()):
            still = np.zeros((count, 2, 3))
            share = np.broadcast_to(np.median(sampled.static_share, axis=0), (count, 2))
            return CameraRotations(still, np.broadcast_to(sampled.covariance.mean(0), (count, 2, 3, 3)), share)
    return _rotations_in(recording.frames(), views, recording.indices, progress)


def _rotations_in(
    frames: Iterable[StereoFrame], views: Sequence[ReferenceView], indices: Indices, progress: Progress | None
) -> CameraRotations:
    """The rotations in ``frames``, which are those of the ``indices`` (N,) or some of them."""
    count = len(indices)
    vectors, shares = np.zeros((count, 2, 3)), np.zeros((count, 2))
    covariance = np.tile(np.eye(3), (count, 2, 1, 1))  # of frames that cannot be decoded
    for done, frame in enumerate(frames, 1):
        n = int(np.searchsorted(indices, frame.index))
        for side, image in enumerate((frame.left, frame.right)):
            vectors[n, side], covariance[n, side], shares[n, side] = views[side].rotation_in(image)
        if progress is not None:
            progress(done, count)
    return CameraRotations(vectors, covariance, shares)


def fit_rotation(camera: Camera, before: Array, after: Array) -> tuple[Array, Array, Array]:
    """The rotation vector (3,) that moves points ``before`` (N, 2) px to ``after`` (N, 2), its covariance (3, 3) and
    the weights (N,) of the points, 0 for those that it does not explain."""
    R = np.eye(3)
    for _ in range(ROTATION_FIT_STEPS):
        moved = camera.project(camera.rays(before) @ R.T)
        residual, J = after - moved, rotation_jacobian(camera, moved)
        distance = np.linalg.norm(residual, axis=1)
        # the median of a Rayleigh distribution is 1.177 standard deviations
        sigma = max(float(np.median(distance)) / 1.177, MIN_CORNER_RESIDUAL_PX)
        weights = tukey_weights(distance, sigma)
        A = np.einsum("n,nij,nik->jk", weights, J, J)
        step = np.linalg.solve(A, np.einsum("n,nij,ni->j", weights, J, residual))
        R = cv2.Rodrigues(step)[0] @ R
        if np.abs(step).max() < CONVERGED_STEP_RAD:
            break
    common = (COMMON_MOTION_PX / camera.K[0, 0]) ** 2 * np.eye(3)
    return np.asarray(cv2.Rodrigues(R)[0], float)[:, 0], np.asarray(sigma**2 * np.linalg.inv(A) + common), weights


def rotation_jacobian(camera: Camera, pixels: Array) -> Array:
    """Derivative (N, 2, 3) of ``pixels`` (N, 2) by a small rotation (3,) of the camera's axes."""
    u, v = np.moveaxis(camera.rays(pixels)[..., :2], -1, 0)
    by_u, by_v = np.stack([-u * v, 1.0 + u * u, -v], -1), np.stack([-(1.0 + v * v), u * v, u], -1)
    return np.stack([by_u * camera.K[0, 0], by_v * camera.K[1, 1]], axis=-2)


def expected_rotations(rotations: CameraRotations) -> Array:
    """The rotations (N, 2, 3) rad expected from the estimates, 0 about axes about which a camera does not turn, and in
    frames in which its rotation is not known.

    About each axis of each camera they have as their prior a normal distribution, whose variance is what the estimates
    scatter beyond their own uncertainty. A camera turns where that is `MIN_LOG_ODDS` likelier than no variance at all.
    """
    noise = np.diagonal(rotations.covariance, axis1=-2, axis2=-1)
    known = rotations.is_known[..., None]
    count = known.sum(0)
    share = known / np.maximum(count, 1)
    ratio = np.maximum((share * rotations.vectors**2 / noise).sum(0), 1.0)
    log_odds = 0.5 * count * (ratio - 1.0 - np.log(ratio))
    swaying = np.where(log_odds > MIN_LOG_ODDS, np.maximum((share * (rotations.vectors**2 - noise)).sum(0), 0.0), 0.0)
    return np.asarray(known * rotations.vectors * swaying / (swaying + noise))
