"""A run: its settings, its beginning, its loop, its folder, its end."""
