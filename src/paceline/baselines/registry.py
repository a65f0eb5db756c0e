"""Imports every comparison method: a method is registered when the module that defines it is imported."""

from paceline.baselines import kalman, lucas_kanade, multimodal, sift

MODULES = sift, kalman, multimodal, lucas_kanade
