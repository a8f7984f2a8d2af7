"""Fuzz target: a story file. The reader refuses it in one sentence, or the text of the story without the agents'
reactions gives the same story.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.report.stories.story_file import is_story, read_story
from tests.fuzz.finding import require, sound

STORIES = Path(__file__).parents[2] / "stories"
LARGEST_SEED = 2500


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "fuzz.story"
        path.write_bytes(data)
        a_story = is_story(path)
        try:
            story = read_story(path)
        except HarnessError as error:
            sound(str(error))
            return
        require(a_story, "it is read as a story, and does not look like one")
        anew = story.with_answers([["answered"] for _ in story.sections])
        path.write_text(anew, encoding="utf-8")
        again = read_story(path)
        require(again.scenario == story.scenario, "a story that was written anew is another")
        seconds = [[(section.from_s, section.until_s) for section in read.sections] for read in (story, again)]
        require(seconds[0] == seconds[1], "a story that was written anew has other sections")
        require(again.with_answers([["answered"] for _ in again.sections]) == anew, "written twice, it differs")
    _ = story.in_virtual_time


def seeds(flown: Path) -> Iterator[bytes]:
    for story in sorted(STORIES.glob("*.story")):
        if story.stat().st_size < LARGEST_SEED:
            yield story.read_bytes()
