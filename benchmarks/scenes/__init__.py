"""Scenes for the tasks, each built by its module without any file to fetch."""
