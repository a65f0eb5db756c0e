"""The registry of comparison methods: each is registered where it is defined, when this module is imported."""

from paceline.baselines import kalman, lucas_kanade, multimodal, sift, zhu_filter

BASELINE_MODULES = sift, kalman, multimodal, lucas_kanade, zhu_filter
