"""Generate the tables in `docs/reference/scenario-keys.md`.

The JSON Schema of a scenario has the types and defaults. The docstrings of the models have the descriptions.
"""

import ast
import inspect
import json
from typing import Any, get_args

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from pydantic import BaseModel

from docs.generate.json_schemas import generate
from harness.scenario import Scenario
from ucp.quirks import QUIRKS
from ucp.settings import DECLARED, NumberSetting

MARK = "<!-- keys -->"
ABOUT = {
    "Offset": "A position relative to the first home: metres east, north and up, and a heading in degrees.",
    "Settings": "Settings of all agents. Durations are mission seconds, sizes are bytes.",
}
"""The introduction of a model's table, for models without a description in the schema."""
QUIRKS_SECTION = "Quirks"
ABOUT_QUIRKS = """A quirk is a mistake that an agent makes on purpose. `crash_on_tie: true` applies to all agents, and
`crash_on_tie: {agents: [2, 3]}` to agents 2 and 3. `ignore_commit: 0.2` sets the probability of the mistake for all
agents, and `ignore_commit: {agents: [2], value: 0.2}` for agent 2. An unknown name of a quirk is an error."""


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    return markdown.replace(MARK, reference()) if MARK in markdown else markdown


def reference() -> str:
    """Return a table of the keys of a scenario, and a table for each model that a scenario contains."""
    schema = generate("scenario")
    models = _models(Scenario)
    parts = [_table("Scenario", schema, models)]
    for name in sorted(schema["$defs"]):
        parts.append(f"## {name}\n\n{_table(name, schema['$defs'][name], models)}")
    parts.append(f"## {QUIRKS_SECTION}\n\n{_quirks()}")
    return "\n\n".join(parts)


def _quirks() -> str:
    """Return a table of all deliberate errors of agents, in the order of their Algorithms."""
    rows = ["| quirk | value | mistake |", "|---|---|---|"]
    for name, quirk in QUIRKS.items():
        rows.append(f"| `{name}` | {'probability 0 to 1' if quirk.chance else 'true'} | {quirk.sentence} |")
    return f"{ABOUT_QUIRKS}\n\n" + "\n".join(rows)


def _table(name: str, schema: dict[str, Any], models: dict[str, type[BaseModel]]) -> str:
    about = ABOUT.get(name) or schema.get("description", "")
    if "properties" not in schema:
        return f"{about}\n\n{_type(schema)}"
    documented = _docstrings(models[schema["title"]]) if schema.get("title") in models else {}
    rows = ["| key | value | default | |", "|---|---|---|---|"]
    for key, value in schema["properties"].items():
        default = "" if value.get("default") is None else f"`{json.dumps(value['default'])}`"
        if key in schema.get("required", []):
            default = "required"
        elif len(default) > 40:
            default = ""
        declared = DECLARED.get(key) if schema.get("title") == "Settings" else None
        text = (
            value.get("description")
            or documented.get(key)
            or documented.get(f"{key}_")
            or (f"{declared.sentence}" if declared else "")
        )
        kind = f"{_type(value)}, {declared.allowed}" if isinstance(declared, NumberSetting) else _type(value)
        cells = (f"`{key}`", kind, default, text.replace("<", "&lt;"))
        rows.append("| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in cells) + " |")
    return f"{about}\n\n" + "\n".join(rows)


def _type(schema: dict[str, Any]) -> str:
    """Return a description of the values that a key allows."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if "anyOf" in schema or "oneOf" in schema:
        choices = [choice for choice in (schema.get("anyOf") or schema["oneOf"]) if choice.get("type") != "null"]
        return " or ".join(dict.fromkeys(map(_type, choices)))
    if "prefixItems" in schema:
        return f"list of {len(schema['prefixItems'])}: {', '.join(map(_type, schema['prefixItems']))}"
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if schema.get("type") == "object":
        values = schema.get("additionalProperties")
        if "properties" in schema:
            return f"mapping of [{QUIRKS_SECTION}](#{QUIRKS_SECTION.lower()})"
        if not isinstance(values, dict):
            return "mapping"
        names = schema.get("propertyNames", {}).get("enum", [])
        keys = f" from {', '.join(f'`{name}`' for name in names)}" if names else ""
        return f"mapping{keys} to {_type(values)}"
    bounds = [
        f"{sign} {schema[bound]:.10g}"
        for bound, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if bound in schema
    ]
    return ", ".join([schema.get("type", "anything"), *bounds])


def _models(model: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return the model and all models that it contains, directly or indirectly. The keys are their names."""
    found: dict[str, type[BaseModel]] = {}

    def visit(annotation: Any) -> None:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel) and annotation.__name__ not in found:
            found[annotation.__name__] = annotation
            for field in annotation.model_fields.values():
                visit(field.annotation)
        for part in get_args(annotation):
            visit(part)

    visit(model)
    return found


def _docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each attribute of a model and of its base classes. They are read from the source code."""
    documented: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if base.__module__.startswith("harness."):
            documented |= _own_docstrings(base)
    return documented


def _own_docstrings(model: type) -> dict[str, str]:
    try:
        (definition,) = ast.parse(inspect.cleandoc("\n" + inspect.getsource(model))).body
    except (OSError, TypeError, ValueError):  # `create_model` made the class: it has no source
        return {}
    assert isinstance(definition, ast.ClassDef), f"{model} is a class"
    documented, name = {}, None
    for statement in definition.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            name = statement.target.id
        elif name and isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            documented[name], name = str(statement.value.value), None
        else:
            name = None
    return documented
