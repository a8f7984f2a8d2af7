"""`ucp-harness clean`: remove what runs on Docker left behind when they were killed."""

from rich.console import Console


def clean_command() -> None:
    """Remove the containers of runs on Docker that are over; those of a run that goes on, and all others, stay."""
    from harness.play.containers.docker_engine import Engine
    from harness.play.containers.leftovers import clean

    engine = Engine.connect()
    try:
        cleaned = clean(engine)
    finally:
        engine.close()
    console = Console()
    for name in cleaned.removed:
        console.print(f"removed {name}", highlight=False, soft_wrap=True)
    if not cleaned.removed:
        console.print("there was nothing to remove", highlight=False)
    if cleaned.still:
        console.print(f"{len(cleaned.still)} containers belong to runs that go on", highlight=False, style="dim")
