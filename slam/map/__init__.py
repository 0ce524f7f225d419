"""The map: landmarks, the state that the steps share, and sparsification."""
