"""Motion files of other programs, read with distrust and written whole."""
