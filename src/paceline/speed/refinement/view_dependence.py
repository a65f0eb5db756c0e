"""How what a face shows drifts with the direction that it is seen from, and how views tell of motion all the same.

What glossy paint and lamps mirror moves over the face as the vehicle comes nearer, and passes for a motion. Both views
of a frame see it from almost the same direction, and so alike: their disparities hardly suffer. Frames far apart do
not. So intensities are taken to drift with the direction, as Lévy's Brownian motion: the variance of a difference grows
with the angle, at a pace that each patch has of its own. Views are weighed as such errors ask for (generalised least
squares); where nothing drifts these are the usual weights.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Floats

PACES = np.array([0.0, *np.geomspace(0.03, 300.0, 25)])  # variance of the drift over that of noise, in the mean


def centred(say: Array) -> Array:
    """Matrices (K, V, V) that weigh the V views of each of K patches by their ``say`` (V, K), and take out what all of
    these have in common, which the shared texture follows."""
    root = np.sqrt(say).T
    unit = root / np.maximum(np.linalg.norm(root, axis=-1, keepdims=True), 1e-9)
    return np.asarray((np.eye(root.shape[1]) - unit[:, :, None] * unit[:, None]) * root[:, None])


def whitened(residuals: Array | Floats, say: Array, directions: Array) -> Array:
    """Matrices (K, V, V) like those of `centred` that make what drifts as independent as noise from view to view.

    ``residuals`` (V, K, m) tell each patch's pace, which is the likeliest of PACES with the noise that is likeliest
    beside it, free of what is common (restricted maximum likelihood); ``say`` (V, K) is none for views that show
    something else. ``directions`` (V, 3) are unit vectors.
    """
    centring = centred(say)
    # minus the distance is a covariance, in any number of dimensions, of all that has no common part
    apart = np.linalg.norm(directions[:, None] - directions, axis=-1)
    size, axes = np.linalg.eigh(centring @ -apart @ centring.swapaxes(1, 2))
    size = np.maximum(size, 0.0)
    size /= np.maximum(size.mean(-1, keepdims=True), 1e-12)
    back = axes.swapaxes(1, 2)
    power = np.square(back @ centring @ residuals.swapaxes(0, 1)).mean(-1)
    shares = 1.0 / (1.0 + PACES[:, None] * size[:, None])
    noise = np.maximum((shares @ power[:, :, None])[..., 0], 1e-12)
    contrasts = np.maximum((say > 0.0).sum(0) - 1, 0)
    loss = contrasts[:, None] * np.log(noise) - np.log(shares).sum(-1)
    patches, likeliest = np.arange(len(loss)), loss.argmin(-1)
    # the say counts all that is left over as noise, and the drift is part of it
    less_noise = noise[:, 0] / noise[patches, likeliest]
    root = np.sqrt(shares[patches, likeliest] * less_noise[:, None])
    return np.asarray(axes * root[:, None] @ back @ centring)
