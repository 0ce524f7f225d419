"""Clouds in files: one scan, or a cloud of any origin, whatever its format."""

from slam.io.clouds.cloud import Cloud
from slam.io.clouds.read import CLOUD_SUFFIXES, is_cloud_file, read_cloud, weigh_cloud

__all__ = ["CLOUD_SUFFIXES", "Cloud", "is_cloud_file", "read_cloud", "weigh_cloud"]
