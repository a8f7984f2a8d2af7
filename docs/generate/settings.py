"""Write the table of settings in the agent contract: `python -m docs.generate.settings`.

The table is generated from the declarations of the settings.
"""

import json
from pathlib import Path

from docs.generate.matrix_thesis import put_between_markers
from ucp.agent_files import write_atomically
from ucp.settings import ADDED, ALTERNATIVES, DECLARED, ChoiceSetting, NumberSetting, Settings

PAGE = Path(__file__).parents[2] / "ucp" / "contract" / "CONTRACT.md"


def table() -> str:
    """Return Markdown with a row for each setting."""
    lines = [["setting", "range", "default", "feature", "effect"], ["---"] * 5, *map(_row, DECLARED)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _row(name: str) -> list[str]:
    declared = DECLARED[name]
    default = f"{_code(getattr(Settings(), name))}{', not written' if name in ADDED else ''}"
    allowed = ", ".join(map(_code, declared.values)) if isinstance(declared, ChoiceSetting) else declared.allowed
    by_value = [f"`{feature}`" for feature, (setting, _) in ALTERNATIVES.items() if setting == name]
    features = f"`{name}`" if isinstance(declared, NumberSetting) and declared.is_feature else ", ".join(by_value)
    return [f"`{name}`", allowed, default, features or "none", declared.sentence]


def _code(value: object) -> str:
    return f"`{value if isinstance(value, str) else json.dumps(value)}`"


if __name__ == "__main__":
    write_atomically(PAGE, put_between_markers(PAGE.read_text(encoding="utf-8"), table()))
