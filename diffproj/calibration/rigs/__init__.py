"""Cameras that look at one target together: calibrated jointly, with their places to each other."""
