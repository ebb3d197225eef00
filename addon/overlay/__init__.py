"""What is drawn over the footage in the Clip Editor, and the table of frames."""
