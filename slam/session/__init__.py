"""Sessions: the run on disk, replay and resume, salvage, prior maps."""
