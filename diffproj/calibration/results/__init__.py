"""What a calibration comes to: the camera, its covariance, what it says of itself, and its record in a file."""
