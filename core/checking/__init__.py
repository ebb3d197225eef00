"""What is wrong or doubtful about a take, a rig or a result, found before or without measuring the surface."""
