"""What can be told apart, and what was looked at: level of detection, evidence of sight."""
