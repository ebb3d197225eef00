"""The stages of the fit: click frame, pose tracking from frame to frame, whole sequence."""
