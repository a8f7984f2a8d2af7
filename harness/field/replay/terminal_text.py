"""Words for a terminal, whatever a record has for words: nothing of it moves the cursor or colours what follows."""

from rich.text import Text

_CONTROL = dict.fromkeys((*range(32), *range(127, 160)), "�")


def shown(words: str, style: str = "") -> Text:
    """One line; what no reader could see is shown as a replacement character."""
    return Text(words.translate(_CONTROL), style=style)
