"""Where a fit without joint clicks begins: the frame, the pose and the stature of the person, with a probability."""
