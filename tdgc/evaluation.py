from tdgc.benchmark.evaluation import Cell, run_cell

__all__ = ["Cell", "run_cell"]
