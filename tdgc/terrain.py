from tdgc.sim.terrain import make_tile

__all__ = ["make_tile"]
