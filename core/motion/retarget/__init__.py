"""Retargeting: the motion of one skeleton onto another, whatever their rest poses, bone rolls, names and proportions."""
