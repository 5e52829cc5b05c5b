"""A rich lens from the poorer ones that it contains: its lowest minimum that is a lens, of many that there are."""
