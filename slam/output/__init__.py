"""Output: the files and the folder of a run, numbers, exports."""
