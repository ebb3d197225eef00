"""Motion as files, and its way to other bodies."""
