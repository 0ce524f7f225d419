"""Front end: from scans to keyframes and their observations; odometry, deskewing, push-broom windows, input checks."""
