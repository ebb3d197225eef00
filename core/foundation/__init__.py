"""What everything rests on: errors, settings, progress, threads, read-only arrays, files written whole, and the lock of a folder."""
