"""The exported pair of policies, run as on a robot: from the exported folder alone."""
