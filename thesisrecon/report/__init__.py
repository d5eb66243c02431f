"""The HTML report and the summary of one run."""
