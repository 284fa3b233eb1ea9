"""Safety Gym's worlds in MuJoCo MJX."""
