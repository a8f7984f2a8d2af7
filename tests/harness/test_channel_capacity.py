"""Test the program that measures how many vehicles a shared radio channel can serve, and its page."""

from docs.generate.channel_capacity import MISSIONS, PAGE, RADIOS, SEEDS, Cell, Run, carried, play, put, size_row


def run(share: float, *, finished: bool = True) -> Run:
    return Run(finished, share, share, 1.0, 0.1, 0.0, 0.0, 0, 1.0)


def test_page_has_the_figures_of_a_small_cell() -> None:
    cell = Cell("busy", "wifi_1", 5)
    row = " | ".join(size_row(cell, [play((cell, seed)) for seed in range(1, SEEDS + 1)]))
    assert f"| {row} |\n" in PAGE.read_text(encoding="utf-8")


def test_radio_carries_sizes_up_to_the_first_failure() -> None:
    runs = {Cell("busy", "wifi_1", agents): [run(1.0), run(0.9)] for agents in MISSIONS["busy"]}
    assert carried(runs, "busy", "wifi_1", 0.005) == 30
    runs[Cell("busy", "wifi_1", 10)] = [run(1.0), run(0.8)]
    assert carried(runs, "busy", "wifi_1", 0.005) == 5
    runs[Cell("busy", "wifi_1", 2)] = [run(1.0), run(1.0, finished=False)]
    assert carried(runs, "busy", "wifi_1", 0.005) == 0


def test_page_has_each_radio_in_the_table_of_sizes() -> None:
    page = PAGE.read_text(encoding="utf-8")
    rows = page.split("<!-- size: begin -->\n")[1].split("<!-- size: end -->")[0]
    for radio in ("no channel", *(f"`{radio}`" for radio in RADIOS)):
        assert rows.count(f"| {radio} |") == len(MISSIONS["busy"])


def test_table_replaces_the_old_table_between_its_markers() -> None:
    page = "a\n<!-- size: begin -->\nold\n<!-- size: end -->\nb\n"
    assert put(page, "size", "new\n") == page.replace("old", "new")
