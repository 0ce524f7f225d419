"""ROS 1 and 2 bags without ROS: opening, frames, odometry, messages as arrays, what is left of a damaged one."""
