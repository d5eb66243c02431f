"""What the pipeline runs: one field per stage, each holding the variant that does its work.

The presets are ``default`` (the best path we have) and ``thesis`` (the pipeline as the thesis describes it).
"""
