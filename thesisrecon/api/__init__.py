"""The public functions, a file for each task; ``thesisrecon/__init__.pyi`` lists their names."""
