from tdgc.sim.commands import CommandDecoder

__all__ = ["CommandDecoder"]
