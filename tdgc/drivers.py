from tdgc.benchmark.drivers import BaselineDriver, HierarchyDriver, load_high

__all__ = ["BaselineDriver", "HierarchyDriver", "load_high"]
