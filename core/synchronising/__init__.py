"""When each view of a take began, found in its footage."""
