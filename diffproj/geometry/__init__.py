"""Cameras, planes, and the maps between pixels, rays and world points."""
