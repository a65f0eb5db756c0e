"""The registry of comparison methods: each is registered where it is defined, when this module is imported."""

from paceline.baselines import kalman, lucas_kanade, multimodal, sift

BASELINE_MODULES = sift, kalman, multimodal, lucas_kanade
