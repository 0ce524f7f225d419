"""Back end: the factor graph in iSAM2, its marginals, and poses that were marginalized."""
