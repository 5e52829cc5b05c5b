"""Lens models: from directions in the camera frame to distorted points on the normalised plane, and exactly back."""
