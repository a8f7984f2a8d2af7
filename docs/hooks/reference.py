"""All keys of a scenario, from its JSON Schema and the docstrings of its models: `docs/reference/scenario-keys.md`."""

import ast
import inspect
import json
from typing import Any, get_args

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from pydantic import BaseModel

from harness.json_schemas import generate
from harness.scenario import Scenario

MARK = "<!-- keys -->"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    return markdown.replace(MARK, reference()) if MARK in markdown else markdown


def reference() -> str:
    """A table for the scenario, and one for every model in it."""
    schema = generate("scenario")
    models = _models(Scenario)
    parts = [_table(schema, models)]
    for name in sorted(schema["$defs"]):
        parts.append(f"## {name}\n\n{_table(schema['$defs'][name], models)}")
    return "\n\n".join(parts)


def _table(schema: dict[str, Any], models: dict[str, type[BaseModel]]) -> str:
    about = schema.get("description", "")
    if "properties" not in schema:
        return f"{about}\n\n{_type(schema)}"
    documented = _docstrings(models[schema["title"]]) if schema.get("title") in models else {}
    rows = ["| key | value | default | |", "|---|---|---|---|"]
    for key, value in schema["properties"].items():
        default = "" if "default" not in value else f"`{json.dumps(value['default'])}`"
        if key in schema.get("required", []):
            default = "needed"
        elif len(default) > 40:
            default = ""
        text = value.get("description") or documented.get(key, "")
        cells = (f"`{key}`", _type(value), default, text.replace("<", "&lt;"))
        rows.append("| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in cells) + " |")
    return f"{about}\n\n" + "\n".join(rows)


def _type(schema: dict[str, Any]) -> str:
    """What a value may be, in words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if "anyOf" in schema or "oneOf" in schema:
        choices = [choice for choice in schema.get("anyOf", schema.get("oneOf")) if choice.get("type") != "null"]
        return " or ".join(dict.fromkeys(map(_type, choices)))
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if schema.get("type") == "object":
        values = schema.get("additionalProperties")
        if not isinstance(values, dict):
            return "mapping"
        return f"mapping of IDs to {_type(values)}" if "propertyNames" in schema else f"mapping to {_type(values)}"
    bounds = [
        f"{sign} {schema[bound]:.10g}"
        for bound, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if bound in schema
    ]
    return ", ".join([schema.get("type", "anything"), *bounds])


def _models(model: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """The model and all that are in it, by name."""
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
    """What stands below each attribute in the source."""
    try:
        (definition,) = ast.parse(inspect.cleandoc("\n" + inspect.getsource(model))).body
    except (OSError, TypeError, ValueError):  # it was made, not written
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
