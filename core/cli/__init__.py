"""The `tricap` command: one file a command."""
