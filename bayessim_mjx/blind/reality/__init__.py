"""A finer reality in MuJoCo C with causes of its own; nothing of the library's physics and effects is used."""
