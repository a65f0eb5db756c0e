"""Physically rendered worlds with exact truth: objects, motion, light and sensor."""
