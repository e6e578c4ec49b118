from tdgc.sim.gaits import GAITS, PhaseClock

__all__ = ["GAITS", "PhaseClock"]
