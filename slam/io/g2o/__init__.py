"""g2o files: graphs of poses and planes, reading and writing."""
