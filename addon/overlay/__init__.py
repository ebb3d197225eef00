"""Results and corrections drawn over the footage in the Clip Editor, and the list of doubtful frames."""
