"""Loop closure: candidates, their verification, and closing."""
