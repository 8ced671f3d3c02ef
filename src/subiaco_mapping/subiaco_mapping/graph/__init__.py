"""The pose graph in local ENU (gtsam): odometry, loops, gravity, GNSS with lever arm, heading."""
