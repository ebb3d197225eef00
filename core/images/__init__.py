"""Image sequences, video fields, contrast enhancement and sub-pixel sampling."""
