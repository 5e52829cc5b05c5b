"""Whether a fit is to be believed: how sure it is, what it leaves over, and what else would explain the corners."""
