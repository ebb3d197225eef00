"""The body: skeleton, metaballs and the skin around them."""
