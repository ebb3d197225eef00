"""What the fit is made from, read from the take and from the results of the earlier stages."""
