"""Section 4.2.2: correlation, strength of match, growth, alignment and tracks."""
