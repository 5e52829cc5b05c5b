"""From corners to a minimum: what was given, checked; where to start; the fit; and looks at other minima."""
