"""Cross-checks of thesisrecon against reference tools and truth."""
