"""View-dependent appearance: a covariance of the residuals between views, for specular reflections.

Reflections in paint and lamps move over the vehicle as it approaches, which looks like motion. Both views of a frame
have almost the same direction, so their disparity is hardly affected; frames far apart differ more. Intensities are
therefore modelled as a random process over the viewing direction (Lévy's Brownian motion): the variance of a difference
grows with the angle between two views, at a rate estimated for each patch. Views are weighted by generalised least
squares; where appearance does not change, these are the ordinary weights.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Floats

VARIANCE_RATIOS = np.array([0.0, *np.geomspace(0.03, 300.0, 25)])  # view-dependent over noise, averaged over the views


def centering(weights: Array) -> Array:
    """Matrices (K, V, V) that weight the V views of K patches by ``weights`` (V, K) and remove their weighted mean.

    The mean is what the shared texture explains.
    """
    root = np.sqrt(weights).T
    unit = root / np.maximum(np.linalg.norm(root, axis=-1, keepdims=True), 1e-9)
    return np.asarray((np.eye(root.shape[1]) - unit[:, :, None] * unit[:, None]) * root[:, None])


def whitening(residuals: Array | Floats, weights: Array, directions: Array) -> Array:
    """Matrices (K, V, V) as of `centering` that also decorrelate the view-dependent part.

    Each patch's variance ratio is the most likely of VARIANCE_RATIOS by its ``residuals`` (V, K, m), with the noise
    variance that is most likely beside it (restricted maximum likelihood). ``weights`` (V, K) are zero for views that
    are not to be used; ``directions`` (V, 3) are unit vectors to the cameras.
    """
    centre = centering(weights)
    # minus the distance is a valid covariance of contrasts, in any number of dimensions
    distance = np.linalg.norm(directions[:, None] - directions, axis=-1)
    size, axes = np.linalg.eigh(centre @ -distance @ centre.swapaxes(1, 2))
    size = np.maximum(size, 0.0)
    size /= np.maximum(size.mean(-1, keepdims=True), 1e-12)
    back = axes.swapaxes(1, 2)
    power = np.square(back @ centre @ residuals.swapaxes(0, 1)).mean(-1)
    shares = 1.0 / (1.0 + VARIANCE_RATIOS[:, None] * size[:, None])
    noise = np.maximum((shares @ power[:, :, None])[..., 0], 1e-12)
    contrasts = np.maximum((weights > 0.0).sum(0) - 1, 0)
    loss = contrasts[:, None] * np.log(noise) - np.log(shares).sum(-1)
    patches, likeliest = np.arange(len(loss)), loss.argmin(-1)
    # the weights count the whole residual as noise, of which the view-dependent part is now apart
    less_noise = noise[:, 0] / noise[patches, likeliest]
    root = np.sqrt(shares[patches, likeliest] * less_noise[:, None])
    return np.asarray(axes * root[:, None] @ back @ centre)
