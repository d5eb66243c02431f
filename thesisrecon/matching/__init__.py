"""Section 4.2.2: corresponding feature points of two photographs, and tracks over all of them."""
