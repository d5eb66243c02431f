"""The package as somebody gets it: built, installed into an empty environment, and used from an empty folder.

``python -m validation.studies.package`` says each step.
"""
