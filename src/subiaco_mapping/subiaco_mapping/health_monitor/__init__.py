"""The state of sensors, clocks and disk during a drive, and whether the survey is usable."""
