"""The eight numbered steps from footage to a rig that moves: the state of each, what it offers, and how it is drawn."""
