"""Where a camera is, from evidence of any kind: landmarks, horizon, lengths, vanishing points."""
