"""Floor plans: walls, openings and rooms of every storey from planes and their joint covariance."""

from slam.floorplan.joint_planes import JointPlanes, joint_planes
from slam.floorplan.plan import FloorPlan, floor_plan
from slam.floorplan.quantities import Quantity

__all__ = ["FloorPlan", "JointPlanes", "Quantity", "floor_plan", "joint_planes"]
