"""Recording of a live vehicle: counters that reveal every loss, splits, watermarks. No ROS here."""
