"""Pages that need nothing but a browser: the report on a calibration."""
