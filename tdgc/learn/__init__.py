"""Learning: run folder and loop, the recurrent policy, imitation."""
