"""The simulated world: terrain, robot, gaits and the commands that drive it."""
