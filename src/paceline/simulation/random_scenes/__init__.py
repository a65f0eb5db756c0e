"""Scenes drawn at random, varied enough to evaluate a measurement and its intervals."""
