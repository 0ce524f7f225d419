"""Registration: where am I? Planes laid on planes, scan matching, place recognition, visibility, relocalization."""
