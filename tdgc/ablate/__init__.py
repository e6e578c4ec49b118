"""Ablation study: variants of the hierarchy, their trials and the table of results."""
