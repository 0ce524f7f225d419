"""What was seen from different keyframes, held against each other: of level lasers, of 3D sensors."""
