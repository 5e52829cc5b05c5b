"""From views of a target to cameras with covariance."""
