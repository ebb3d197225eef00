"""A take: one recording of a person, its take.toml, its footage, and what the user marked in it."""
