"""What is minimised: residuals of a target's points, by parameters that have names."""
