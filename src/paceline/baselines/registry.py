"""The methods that Paceline is compared with. Each is registered where it is defined, when this module is imported."""

from paceline.baselines import kalman, lucas_kanade, multimodal, sift

MODULES = sift, kalman, multimodal, lucas_kanade
