"""Run reports, gates, ablations and studies: processes, resume, tables and pages."""
