"""The benchmark: drivers, episodes and their analysis."""
