"""Section 4.2.2: corresponding feature points of two images, and tracks over all of them."""
