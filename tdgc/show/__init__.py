"""What is looked at: figures, films, the report, Bullet's window."""
