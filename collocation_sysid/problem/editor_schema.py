"""JSON schema of the problem file for editors.

Editors with Taplo (such as Even Better TOML) complete and check the keys of a TOML file whose first
line names a schema: ``#:schema``, followed by an address or by a path relative to the file.
"""

from __future__ import annotations

import json

from ..common.pages import documentation_url
from .schema import ProblemFile

SCHEMA_FILE = "schema.json"
SCHEMA_DIRECTIVE = "#:schema "
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema_text() -> str:
    """Return the JSON schema of the problem file as text that ends with a newline."""
    schema = {"$schema": DIALECT, **ProblemFile.model_json_schema()}
    return json.dumps(schema, indent=1) + "\n"


def schema_url() -> str | None:
    """Return the address at which the documentation publishes the schema; None if the documentation
    has no address.
    """
    base = documentation_url()
    return None if base is None else f"{base}/{SCHEMA_FILE}"


def with_schema_reference(text: str, reference: str) -> str:
    """Return the text of a TOML file with a first line that names a schema.

    Parameters
    ----------
    text : str
        A first line that names another schema is replaced.
    reference : str
        Address of the schema, or its path relative to the TOML file.

    Returns
    -------
    str
        The text with the first line ``#:schema REFERENCE`` inserted, or replaced.
    """
    first, newline, rest = text.partition("\n")
    body = rest if first.startswith(SCHEMA_DIRECTIVE) and newline else text
    return f"{SCHEMA_DIRECTIVE}{reference}\n{body}"
