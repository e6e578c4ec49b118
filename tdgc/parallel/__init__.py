"""Parallel simulation of many robots in worker processes, on this machine or on a cluster."""
