"""Measuring with error bars: points, lengths, angles and areas on a plane, and where in the image to trust them."""
