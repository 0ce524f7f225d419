"""GTSAM factors from SP planes, laser lines and odometry."""
