"""Visualisation: figures, films, the report and Bullet's window."""
