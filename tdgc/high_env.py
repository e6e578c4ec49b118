from tdgc.tasks.high_env import load_low

__all__ = ["load_low"]
