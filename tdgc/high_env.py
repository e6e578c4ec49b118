from tdgc.tasks.pairing import load_low

__all__ = ["load_low"]
