"""Scene points seen by both cameras: SIFT features matched between the views of a clip."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices
from paceline.cameras import StereoRig
from paceline.geometry import epipolar_distance, triangulate
from paceline.progress import Progress
from paceline.recordings.stereo import StereoRecording
from paceline.sift_features import detect_features, match_descriptors

MAX_FRAMES = 6  # evenly spread frames: static points recur in every frame and add little
MAX_FEATURES = 3000  # features per view
SCENE_LOWE_RATIO = 0.75  # ratio of the distances to the best and the second best descriptor (Lowe 2004)
MAX_EPIPOLAR_SHARE = 0.04  # epipolar distance beyond which a match is rejected, as a share of the image's height
TILE_PX = 64


@dataclass(frozen=True, eq=False)
class SceneMatches:
    """N points seen by both cameras: ideal pixels (N, 2) in each view, and in which ``tile`` (N,) of the left one.

    Errors of points in one tile are treated as correlated: the same static object is seen there in every frame, through
    the same part of the lenses.
    """

    left: Array
    right: Array
    tile: Indices
    frames: int

    def __len__(self) -> int:
        return len(self.left)

    def select(self, chosen: NDArray[np.bool_]) -> SceneMatches:
        return replace(self, left=self.left[chosen], right=self.right[chosen], tile=self.tile[chosen])


def match_scene(recording: StereoRecording, progress: Progress | None = None) -> SceneMatches:
    """Points matched between the views of a few frames."""
    chosen = np.unique(np.linspace(0, len(recording) - 1, min(MAX_FRAMES, len(recording))).round().astype(int))
    detector = cv2.SIFT.create(nfeatures=MAX_FEATURES)
    matches, n_done = [], 0
    for k in chosen:
        for frame in recording.frames(int(recording.indices[k]), int(recording.indices[k]) + 1):
            matches.append(match_views(recording.rig, detector, frame.left, frame.right))
            n_done += 1
        if progress:
            progress(n_done, len(chosen))
    left = np.concatenate([f[0] for f in matches]) if matches else np.empty((0, 2))
    right = np.concatenate([f[1] for f in matches]) if matches else np.empty((0, 2))
    across = recording.image_size[0] // TILE_PX + 1
    x, y = np.maximum(left // TILE_PX, 0).astype(np.int64).T
    return SceneMatches(left, right, y * across + x, n_done)


def match_views(rig: StereoRig, detector: cv2.SIFT, left: Image, right: Image) -> tuple[Array, Array]:
    """Features (n, 2) of two views, matched by mutual choice and the ratio test, near epipolar lines and in front."""
    (a, of_a), (b, of_b) = (detect_features(detector, image) for image in (left, right))
    i, j = match_descriptors(of_a, of_b, SCENE_LOWE_RATIO)
    p, q = a[i], b[j]
    with np.errstate(invalid="ignore", divide="ignore"):
        in_front = triangulate(rig, p, q)[:, 2] > 0
    near_line = np.abs(epipolar_distance(rig, p, q)) < MAX_EPIPOLAR_SHARE * rig.left.image_size[1]
    return p[near_line & in_front], q[near_line & in_front]
