"""Many robots at once: worker processes, on this machine or on a cluster."""
