"""Tracking surface points through the sequence (LSMTA: D'Apuzzo, Plänkers & Fua 2000)."""
