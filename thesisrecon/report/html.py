"""What every page of ours is made with: a template that escapes, and scripts that are known by their hash.

What only pages need is imported when one is made.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2


def template_environment() -> jinja2.Environment:
    """Jinja with all text escaped, no undefined names, and no NaN in JSON."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN is no JSON: better an error here than a page whose script cannot read its data.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment


def page_resource(name: str) -> str:
    """A style, script or template of this folder."""
    return files("thesisrecon.report").joinpath(name).read_text(encoding="utf-8")


def plotly_script() -> str:
    """The text of plotly.js that can stand in an element of a page."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("</script", "<\\/script")


def script_hashes(scripts: Sequence[str]) -> str:
    """What a content security policy names these scripts by."""
    digests = (hashlib.sha256(script.encode("utf-8")).digest() for script in scripts)
    found = [f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests]
    return " ".join(found) or "'none'"
