"""The benchmark: who drives, episodes, and what is found in them."""
