"""Record the animated picture of the live page in the README: `python -m docs.generate.watch_film`.

The script plays a scenario in virtual time, and opens the replay of the run in a headless Chromium. It takes
screenshots at regular mission times, and writes them as an animated WebP. It needs Chromium, and the packages aiohttp
and Pillow.
"""

import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image  # type: ignore[import-not-found]

from tests.harness.report.browser import Browser, open_browser

PICTURE = Path(__file__).parents[1] / "watch.webp"
SCENARIO, SEED = "partition_heal", 1
WIDTH, HEIGHT = 1280, 800
"""Size of the browser window in pixels."""
SCALE = 0.7
"""Size of the picture divided by the size of the window."""
STEP_S = 5
"""Mission seconds between two frames of the picture."""
FRAME_MS = 500
QUALITY = 30
MAX_BYTES = 2_000_000
HARNESS = [sys.executable, "-m", "harness.cli"]


def main() -> None:
    """Write the picture. Fail if the file is too large for the README."""
    with TemporaryDirectory() as directory:
        run = Path(directory) / "run"
        play = ["run", SCENARIO, "--backend", "sim", "--seed", str(SEED), "--out", str(run)]
        subprocess.run([*HARNESS, *play], check=True, stdout=subprocess.DEVNULL)
        with subprocess.Popen([*HARNESS, "watch", str(run)], stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            address = next(found[0] for line in server.stdout if (found := re.search(r"http://\S+", line)))
            try:
                with open_browser(Path(directory)) as opened, opened.fresh() as browser:
                    frames = record(browser, address, Path(directory) / "frame.png")
            finally:
                server.terminate()
    first, *others = frames
    first.save(PICTURE, save_all=True, append_images=others, duration=FRAME_MS, loop=0, quality=QUALITY, method=4)
    size = PICTURE.stat().st_size
    assert size < MAX_BYTES, f"{PICTURE} has {size} bytes: record fewer frames, or lower the quality"


def record(browser: Browser, address: str, shot: Path) -> list[Image.Image]:
    """Return the animated picture, with a frame for every few seconds of the mission."""
    browser.show(address, width=WIDTH, height=HEIGHT, scheme="light")
    while not browser.evaluate("Boolean(window.watch && window.watch.story.end)"):
        pass
    end_s = float(browser.evaluate("+document.getElementById('slider').max"))
    browser.evaluate("window.watch.playing && document.getElementById('play').click()")
    size = round(WIDTH * SCALE), round(HEIGHT * SCALE)
    frames = []
    for time_s in range(0, int(end_s) + STEP_S, STEP_S):
        browser.evaluate(f"window.watch.seek({time_s})")
        browser.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        browser.screenshot(shot)
        frames.append(Image.open(BytesIO(shot.read_bytes())).convert("RGB").crop((0, 0, WIDTH, HEIGHT)).resize(size))
    return frames


if __name__ == "__main__":
    main()
