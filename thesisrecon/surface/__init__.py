"""Section 2.6: from depth maps to a surface with texture."""
