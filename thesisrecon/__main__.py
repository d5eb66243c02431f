"""``python -m thesisrecon``: the same as the command ``thesisrecon``."""

from thesisrecon.cli import main

if __name__ == "__main__":
    main()
