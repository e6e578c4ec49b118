"""tdgc: hierarchical quadruped navigation, from task-level decisions to gait-level control."""

__version__ = "0.1.0"
