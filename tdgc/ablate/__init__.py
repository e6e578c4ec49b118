"""The ablation: variants of the hierarchy, their trials, the table."""
