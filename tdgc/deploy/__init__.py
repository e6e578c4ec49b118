"""The exported pair as a robot runs it, from the exported folder alone."""
