"""The ablation: variants of the hierarchy, their cells, the table."""
