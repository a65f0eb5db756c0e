"""Worlds rendered physically, with exact truth: what stands in them, how it moves, what the light and the sensor do."""
