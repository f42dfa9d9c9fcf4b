"""The methods, one file each or a few that are alike; see `_registry` for how to add one."""
