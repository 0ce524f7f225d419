"""Floor plans: walls, openings and rooms of every storey from planes and their joint covariance."""

from slam.floorplan.plan import FloorPlan, floor_plan
from slam.floorplan.quantities import JointPlanes, Quantity, joint_planes

__all__ = ["FloorPlan", "JointPlanes", "Quantity", "floor_plan", "joint_planes"]
