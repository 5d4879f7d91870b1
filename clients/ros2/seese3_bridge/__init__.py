"""Has a SeeSE3 server follow a robot's camera."""
